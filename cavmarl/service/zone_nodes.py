"""Selection of the nodes that host the zones of a session on several nodes.

The session's own node leads: it receives the commands, and waits for the other nodes at an address
that it reports. The zones are divided into one part per wanted node. For each part, a node is
selected like a node of a session, if possible one without another part of this session. A node that
is lost or drained is replaced, and the worlds continue from the states that other nodes keep
(docs/guides/nodes.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from cavmarl.service.event_log import EventLog
from cavmarl.service.node_selection import Chosen, LiveNode, NoNodeError
from cavmarl.service.request_bodies import DoorBody
from cavmarl.service.service_records import SessionRecord

Choose = Callable[[SessionRecord, Sequence[str]], Chosen]


class ZoneNodes:
    """The zone nodes of all sessions.

    Args:
        log: the event log of the service.
        live: heartbeats of the nodes.
        choose: returns a node for a session; arguments: the session, names of excluded nodes.
    """

    def __init__(self, log: EventLog, live: Mapping[str, LiveNode], choose: Choose) -> None:
        self._log, self._live, self._choose = log, live, choose
        self._doors: dict[str, DoorBody] = {}
        for session in log.state.sessions.values():
            for name in session.members:
                self._live[name].zones_of.append(session.id)

    def gather(self, session: SessionRecord) -> None:
        """Assign the wanted number of nodes to a session, or as many as can host zones."""
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
        """Replace lost zone nodes."""
        for session in list(self._log.state.sessions.values()):
            if session.zone_nodes and session.state == "active":
                self.gather(session)

    def end(self, session: SessionRecord) -> None:
        """Release the zone nodes of an ended session."""
        self._release(session.members, session.id)
        self._doors.pop(session.id, None)

    def open_door(self, session: SessionRecord, door: DoorBody) -> None:
        """Record the address at which the session's node waits for the other nodes."""
        self._doors[session.id] = door

    def tasks(self, name: str) -> list[dict[str, Any]]:
        """Return the addresses to which a node must connect, once per part that it hosts."""
        found = []
        for session in sorted(self._live[name].zones_of):
            door = self._doors.get(session)
            if door is not None:
                found.append({"session": session, **door.model_dump()})
        return found

    def without_door(self, hosted: Sequence[str]) -> list[str]:
        """Return the sessions whose node has not reported its address yet."""
        sessions = self._log.state.sessions
        return [one for one in hosted if sessions[one].zone_nodes and one not in self._doors]

    def _another(self, session: SessionRecord, members: Sequence[str]) -> str | None:
        anywhere = replace(session, preferred=None)
        for avoided in (members, ()):  # prefer a node without a part of this session
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
