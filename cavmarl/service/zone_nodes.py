"""Which nodes host the zones of a session's worlds, where these are over more than one.

The session's own node leads: it takes the commands, and awaits the others at a door that it tells.
They are chosen as nodes of sessions are, on as many machines as there are; one that is lost or
drained is replaced, and the worlds go on from what their buddies have kept (docs/guides/nodes.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from cavmarl.service.event_log import EventLog
from cavmarl.service.node_selection import Chosen, LiveNode, NoNodeError
from cavmarl.service.requests import DoorBody
from cavmarl.service.service_records import SessionRecord

Choose = Callable[[SessionRecord, Sequence[str]], Chosen]


class ZoneNodes:
    """The members of all sessions.

    Args:
        log: of the service.
        live: what is known of nodes.
        choose: a node for a session, but for some.
    """

    def __init__(self, log: EventLog, live: Mapping[str, LiveNode], choose: Choose) -> None:
        self._log, self._live, self._choose = log, live, choose
        self._doors: dict[str, DoorBody] = {}
        for session in log.state.sessions.values():
            for name in session.members:
                self._live[name].zones_of.append(session.id)

    def gather(self, session: SessionRecord) -> None:
        """See that as many nodes as are wanted host zones of a session, if so many can."""
        nodes = self._log.state.nodes
        kept = [
            name
            for name in session.members
            if nodes[name].state == "up" and not nodes[name].draining
        ]
        members = list(kept)
        while len(members) < session.zone_nodes:
            found = self._another(session, members)
            if found is None:
                break
            self._live[found].zones_of.append(session.id)
            self._live[found].refresh()
            members.append(found)
        if members == session.members:
            return
        self._release([name for name in session.members if name not in kept], session.id)
        self._log.record(
            "session.repartitioned", session.id, {"members": members}, owner=session.owner
        )

    def sweep(self) -> None:
        """Replace members that are gone."""
        for session in list(self._log.state.sessions.values()):
            if session.zone_nodes and session.state == "active":
                self.gather(session)

    def end(self, session: SessionRecord) -> None:
        """A session is over: its members are free."""
        self._release(session.members, session.id)
        self._doors.pop(session.id, None)

    def open_door(self, session: SessionRecord, door: DoorBody) -> None:
        """The session's node awaits its members there."""
        self._doors[session.id] = door

    def tasks(self, name: str) -> list[dict[str, Any]]:
        """The doors that a node has to call at, each as often as it is a member."""
        found = []
        for session in sorted(self._live[name].zones_of):
            door = self._doors.get(session)
            if door is not None:
                found.append({"session": session, **door.model_dump()})
        return found

    def without_door(self, hosted: Sequence[str]) -> list[str]:
        """Sessions whose node has not told where it awaits the others."""
        sessions = self._log.state.sessions
        return [one for one in hosted if sessions[one].zone_nodes and one not in self._doors]

    def _another(self, session: SessionRecord, members: Sequence[str]) -> str | None:
        anywhere = replace(session, preferred=None)
        for avoided in (members, ()):  # one that is a member already rather than none
            try:
                return self._choose(anywhere, avoided).node
            except NoNodeError:
                continue
        return None

    def _release(self, names: Sequence[str], session: str) -> None:
        for name in names:
            live = self._live[name]
            if session in live.zones_of:
                live.zones_of.remove(session)
                live.refresh()
