"""The broker: registers nodes and assigns sessions and jobs to them.

All decisions are made in one thread, and no other event is recorded during a decision, so
concurrent requests see each other's effects. The clock is injected.
"""

from __future__ import annotations

import itertools
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from cavmarl.balance.load_score import DEFAULT_RULE, LoadRule, Utilisation
from cavmarl.service.artefacts import Artefacts, Quota
from cavmarl.service.error_names import problem
from cavmarl.service.event_log import EventLog
from cavmarl.service.job_queue import JobQueue
from cavmarl.service.node_reports import NodeReports
from cavmarl.service.node_selection import (
    Chosen,
    LiveNode,
    NoNodeError,
    choose,
    limits_of,
    overloads,
    score_of,
)
from cavmarl.service.request_bodies import MOST_WORLDS, BeatBody, NodeBody, TransfersBody
from cavmarl.service.service_records import (
    SESSION_OVER,
    IdentityRecord,
    NodeRecord,
    SessionRecord,
)
from cavmarl.service.zone_nodes import ZoneNodes

MOST_RESULTS = 256  # files of one job
SHOWN_EXCLUSIONS = 10  # maximum number of excluded nodes that an event lists
MOST_SCORES = 100  # maximum number of LoadScores that a node gets for its pages


@dataclass(frozen=True)
class BrokerRules:
    """Time limits and capacities of a service."""

    beat_s: float = 1.0  # between two heartbeats of a node
    missed_beats: int = 3  # missed heartbeats after which a node is down
    lease_s: float = 30.0  # lifetime of a session's token; the client then asks for a new one
    idle_s: float = 600.0  # idle time after which a session ends
    keep_s: float = 3600.0  # how long ended sessions can be read
    keep_nodes_s: float = 86_400.0  # how long nodes that are down or have left are kept
    max_losses: int = 10  # a job fails if it loses so many nodes without saving a new state
    max_skew_s: float = 5.0  # tolerated difference of the clocks of a node and of the service
    max_nodes: int = 10_000
    max_sessions: int = 1000  # open sessions of one identity
    artefacts: Quota = field(default_factory=Quota)  # quota of one identity
    load: LoadRule = DEFAULT_RULE  # thresholds and weights for the load of a node


class Broker:
    """The nodes, sessions and jobs of a service, and all decisions about them."""

    def __init__(
        self,
        log: EventLog,
        rules: BrokerRules | None = None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.log = log
        self.rules = rules or BrokerRules()
        self.live: dict[str, LiveNode] = {}
        self.refusals = 0
        self.waiting = 0  # number of requests that wait for a node
        self.took_s: Callable[[float], None] = lambda _: (
            None
        )  # called with the duration of each selection
        self._clock_s = clock_s
        self._touched: dict[str, float] = {}  # session → time of its last request
        # session → world, vehicle, source and target of prepared transfers
        self.prepared: dict[str, list[list[int]]] = {}
        now_s = clock_s()
        self._reports = NodeReports(log, now_s, self.rules.max_skew_s)
        self._numbers = itertools.count()  # order of registration of nodes
        for name in log.state.nodes:
            self.live[name] = LiveNode(next(self._numbers), now_s)
        for session in log.state.sessions.values():
            self._touched[session.id] = now_s
            if session.node is not None:
                self.live[session.node].hosted.add(session.id)
        self.zone_nodes = ZoneNodes(log, self.live, self._choose)
        self.artefacts = Artefacts(log, self.rules.artefacts)
        self.jobs = JobQueue(log, self._choose, self._assign, self._fail, clock_s)

    # Nodes

    def register(self, identity: IdentityRecord, body: NodeBody) -> NodeRecord:
        """Register a node, or register it again; reports of its earlier process are refused."""
        known = self.log.state.nodes.get(body.name)
        owner = known and self.log.state.identities.get(known.identity)
        if owner and owner.id != identity.id and not owner.revoked:
            raise problem("forbidden", f"node '{body.name}' belongs to another identity")
        if known is None and len(self.log.state.nodes) >= self.rules.max_nodes:
            raise problem("too-many", f"the limit is {self.rules.max_nodes} nodes", 60.0)
        incarnation = known.incarnation + 1 if known else 1
        data = body.model_dump(exclude={"name"})
        data |= {"identity": identity.id, "incarnation": incarnation}
        self.log.record("node.registered", body.name, data, actor=identity.id)
        number = self.live[body.name].number if known else next(self._numbers)
        self.live[body.name] = LiveNode(number, self._clock_s())
        return self.log.state.nodes[body.name]

    def beat(self, identity: IdentityRecord, name: str, body: BeatBody) -> dict[str, Any]:
        """Record a heartbeat with the node's load, and return what the node has to do."""
        node = self.own_node(identity, name)
        live = self.live[name]
        if body.incarnation != node.incarnation:
            raise problem(
                "superseded",
                f"node '{name}' has incarnation {node.incarnation} now: end this process",
            )
        if node.state == "left":
            raise problem("conflict", f"node '{name}' has left: register it again")
        if body.sequence <= live.beat:
            raise problem(
                "stale-beat", f"heartbeat {body.sequence} of '{name}' arrived after {live.beat}"
            )
        if node.state == "down":
            self.log.record("node.up", name)
        live.heard_s, live.beat = self._clock_s(), body.sequence
        live.use = Utilisation(body.cpu, body.ram, body.gpu)
        live.counters, live.jobs = dict(body.counters), dict(body.jobs)
        live.muted.clear()
        live.refresh()
        resources = overloads(live.use, self.rules.load)
        if resources != node.excluded:
            kind = "node.overloaded" if resources else "node.admissible"
            self.log.record(kind, name, {"resources": resources, **asdict(live.use)})
        self._reports.accept(name, body.sent_s)
        self.jobs.place()
        return {
            "draining": node.draining,
            "beat_s": self.rules.beat_s,
            "sessions": sorted(live.hosted),
            "zones_of": self.zone_nodes.tasks(name),
            "without_door": self.zone_nodes.without_door(sorted(live.hosted)),
            "jobs": [self._job_of(one) for one in sorted(live.hosted)
                     if self.log.state.sessions[one].job is not None],
            "scores": self._scores() if body.watched else [],
        }  # fmt: skip

    def _scores(self) -> list[dict[str, Any]]:
        """Return the LoadScores that pages show, of nodes that have not left."""
        nodes = [one for _, one in sorted(self.log.state.nodes.items()) if one.state != "left"]
        return [
            {"name": one.name, "state": "draining" if one.draining else one.state,
             "score": score_of(one, self.live[one.name], self.rules.load),
             "sessions": len(self.live[one.name].hosted)}
            for one in nodes[:MOST_SCORES]
        ]  # fmt: skip

    def misreported(self, identity: IdentityRecord, name: str, detail: str) -> None:
        """Record that a node reports an impossible value, such as 85 instead of 0.85."""
        node = self.log.state.nodes.get(name)
        if node is not None and node.identity == identity.id:
            self._reports.refuse(name, detail)

    def own_node(self, identity: IdentityRecord, name: str) -> NodeRecord:
        """Return a node that this identity may act for."""
        node = self.log.state.nodes.get(name)
        if node is None:
            raise problem("not-found", f"there is no node '{name}': register it")
        if identity.role == "node" and node.identity != identity.id:
            raise problem("forbidden", f"node '{name}' belongs to another identity")
        return node

    def drain(self, identity: IdentityRecord, name: str, is_on: bool = True) -> NodeRecord:
        """Assign nothing more to a node; its sessions move when their clients ask again."""
        node = self.own_node(identity, name)
        if node.draining != is_on:
            kind = "node.drained" if is_on else "node.resumed"
            self.log.record(kind, name, actor=identity.id)
        return node

    def leave(self, identity: IdentityRecord, name: str) -> NodeRecord:
        """Remove a node; its sessions wait for another node."""
        node = self.own_node(identity, name)
        if node.state != "left":
            self.log.record("node.left", name, actor=identity.id)
            self._empty(name)
        return node

    def age_s(self, name: str) -> float:
        """Return the seconds since the last heartbeat of a node."""
        return self._clock_s() - self.live[name].heard_s

    def sweep(self) -> None:
        """Mark nodes that missed their heartbeats as down, and end idle sessions."""
        now_s = self._clock_s()
        for name, node in list(self.log.state.nodes.items()):
            age_s = now_s - self.live[name].heard_s
            missed = age_s / self.rules.beat_s
            if node.state == "up" and missed > self.rules.missed_beats:
                self.log.record("node.down", name, {"missed_beats": int(missed)})
                self._empty(name)
            elif node.state != "up" and age_s > self.rules.keep_nodes_s:
                self.log.record("node.forgotten", name)
                del self.live[name]
                self._reports.forget(name)
        for session in list(self.log.state.sessions.values()):
            idle_s = now_s - self._touched[session.id]
            if session.state in SESSION_OVER:
                if idle_s > self.rules.keep_s:
                    self._forget(session)
            elif session.job is None and idle_s > self.rules.idle_s:
                self._tell(session, "timeout", {"of": "idle session", "after_s": idle_s})
                self._end(session, "closed", "service", f"no request for {idle_s:.0f} s")
        self.jobs.end_hopeless(self.rules.max_losses)
        self._reports.watch_own_clock(now_s)
        self.zone_nodes.sweep()
        self.artefacts.sweep()
        self.jobs.place()

    # Sessions and jobs

    def open(
        self,
        identity: IdentityRecord,
        configuration: str,
        *,
        preferred: str | None = None,
        needs: Sequence[str] = (),
        job: dict[str, Any] | None = None,
        zone_nodes: int = 0,
        wait_s: float | None = None,
        key: str = "",
    ) -> SessionRecord:
        """Open a session and assign it to a node.

        A job for which no node is free waits at most `wait_s` (None: no limit). If `key` belongs to
        an earlier request, return the session of that request.

        Raises:
            NoNodeError: no node can accept a session.
        """
        own = [
            one
            for one in self.log.state.sessions.values()
            if one.owner == identity.id and one.state not in SESSION_OVER
        ]
        data: dict[str, Any] = {
            "owner_name": identity.name,
            "configuration": configuration,
            "job": job,
            "needs": list(needs),
            "preferred": preferred,
            "zone_nodes": zone_nodes,
            "wait_s": wait_s,
            "key": key,
        }
        if key and (known := self._of_key(identity, data)) is not None:
            return known
        if len(own) >= self.rules.max_sessions:
            raise problem("too-many", f"{len(own)} sessions are open: close some", 60.0)
        self.artefacts.use(identity, self.log.state.files_of(configuration))
        number = f"s-{secrets.token_hex(12)}"
        session = SessionRecord(id=number, owner=identity.id, **data)
        try:
            chosen = self._choose(session, ())
        except NoNodeError as error:
            if job is None:
                raise
            self.jobs.note(session, error)
            chosen = None
        self.log.record("session.opened", number, data, actor=identity.id, owner=identity.id)
        self._touched[number] = self._clock_s()
        if chosen is not None:
            self._assign(number, chosen)
        return self.log.state.sessions[number]

    def resolve(
        self, identity: IdentityRecord, number: str, unreachable: Sequence[str] = ()
    ) -> SessionRecord:
        """Return a session on its node, or on another node if its own node cannot serve it.

        Another node is chosen if the session's node is lost, drained or unreachable for the client.

        Raises:
            NoNodeError: no node can accept the session.
        """
        session = self.session(identity, number)
        if session.state in SESSION_OVER or session.job is not None:
            raise problem("conflict", f"session '{number}' is {session.state}: open another")
        self._touched[number] = self._clock_s()
        node = self.log.state.nodes.get(session.node or "")
        if node is not None and not node.draining and node.name not in unreachable:
            return session
        chosen = self._choose(session, unreachable)
        if session.node is not None:
            self.live[session.node].hosted.discard(number)
        self._assign(number, chosen)
        return session

    def refuse(
        self, identity: IdentityRecord, subject: str, error: NoNodeError, waited_s: float = 0.0
    ) -> None:
        """Record that no node could serve the request of `identity` before its deadline."""
        self.refusals += 1
        if waited_s > 0.0:
            told = {"of": "request for a node", "after_s": waited_s}
            self.log.record("session.timeout", subject, told, actor=identity.id, owner=identity.id)
        shown = [one._asdict() for one in error.exclusions[:SHOWN_EXCLUSIONS]]
        data = {"excluded": shown, "excluded_count": len(error.exclusions)}
        self.log.record("session.refused", subject, data, actor=identity.id, owner=identity.id)

    def session(self, identity: IdentityRecord, number: str) -> SessionRecord:
        """Return a session that this identity may see; others are reported as missing."""
        session = self.log.state.sessions.get(number)
        is_own = session is not None and session.owner == identity.id
        if session is None or not (is_own or identity.role in ("viewer", "operator", "admin")):
            raise problem("not-found", f"there is no session '{number}' of yours")
        return session

    def hosted(self, identity: IdentityRecord, number: str) -> SessionRecord:
        """Return a session that a node of this identity hosts now."""
        session = self.log.state.sessions.get(number)
        node = self.log.state.nodes.get(session.node or "") if session else None
        is_own = node is not None and node.identity == identity.id
        if session is None or node is None or not is_own:
            raise problem("lost", f"session '{number}' is on no node of this identity")
        if session.incarnation != node.incarnation:
            raise problem(
                "superseded", f"node '{node.name}' has registered again since it got this session"
            )
        return session

    def close(self, identity: IdentityRecord, number: str) -> SessionRecord:
        """End a session or a job."""
        session = self.session(identity, number)
        if identity.role == "viewer":
            raise problem("forbidden", "viewers cannot close sessions")
        if session.state not in SESSION_OVER:
            self._end(session, "closed", identity.id)
        return session

    def save(self, session: SessionRecord, number: int, content: bytes) -> None:
        """Store the state of a world after a number of commands."""
        if number < session.saved_number:
            raise problem("conflict", f"command {session.saved_number} is stored already")
        sha256 = self.log.keep(content)
        self._tell(session, "saved", {"number": number, "sha256": sha256, "bytes": len(content)})

    def hand_over(self, session: SessionRecord, body: TransfersBody) -> None:
        """Record vehicles that have changed zone, and vehicles whose change is prepared."""
        if any((world := row[0]) >= MOST_WORLDS for row in body.transfers):
            raise problem("refused", f"transfers: world {world} is not below {MOST_WORLDS}")
        if body.transfers:
            data = {"number": body.at, "transfers": body.transfers}
            self._tell(session, "handed_over", data)
        self.prepared[session.id] = body.prepared

    def add_result(self, session: SessionRecord, name: str, content: bytes) -> None:
        """Store a file that a job has produced."""
        if name not in session.results and len(session.results) >= MOST_RESULTS:
            raise problem("too-many", f"a job can have at most {MOST_RESULTS} results")
        sha256 = self.log.keep(content)
        self._tell(session, "result", {"name": name, "sha256": sha256, "bytes": len(content)})

    def finish(self, session: SessionRecord, status: str, message: str) -> None:
        """Record that a job is done or has failed."""
        self._end(session, status, session.node or "service", message)

    # Private methods

    def _of_key(self, identity: IdentityRecord, data: dict[str, Any]) -> SessionRecord | None:
        """Return the session that an identity opened earlier with a request key."""
        for one in self.log.state.sessions.values():
            if one.owner == identity.id and one.key == data["key"]:
                if any(getattr(one, name) != value for name, value in data.items()):
                    raise problem("conflict", f"key '{one.key}' belongs to another request")
                if one.node is None and one.job is None:
                    return self.resolve(identity, one.id)
                return one
        return None

    @property
    def _max_age_s(self) -> float:
        return self.rules.beat_s * self.rules.missed_beats

    def limits_of(self, name: str) -> list[str]:
        """Return why a node accepts no session now, with remedies; empty if it accepts sessions."""
        is_old = self.age_s(name) > self._max_age_s
        return limits_of(self.log.state.nodes[name], self.live[name], is_old, self.rules.load)

    def _choose(self, session: SessionRecord, avoided: Sequence[str]) -> Chosen:
        began_s = time.perf_counter()
        try:
            return choose(
                self.log.state.nodes, self.live, session,
                now_s=self._clock_s(), max_age_s=self._max_age_s, avoided=avoided,
                rule=self.rules.load,
            )  # fmt: skip
        finally:
            self.took_s(time.perf_counter() - began_s)

    def _assign(self, number: str, chosen: Chosen) -> None:
        session = self.log.state.sessions[number]
        redirected = session.preferred not in (None, chosen.node)
        data = {
            "node": chosen.node,
            "incarnation": self.log.state.nodes[chosen.node].incarnation,
            "requested": session.preferred,
            "reason": chosen.outcome,
            "score": chosen.score,
            "excluded": [one._asdict() for one in chosen.exclusions[:SHOWN_EXCLUSIONS]],
            "excluded_count": len(chosen.exclusions),
        }
        self._tell(session, "redirected" if redirected else "assigned", data)
        live = self.live[chosen.node]
        live.hosted.add(number)
        live.muted.add(number)
        live.refresh()
        if session.zone_nodes:
            self.zone_nodes.gather(session)

    def _end(self, session: SessionRecord, word: str, actor: str, message: str = "") -> None:
        if session.node is not None:
            live = self.live[session.node]
            live.hosted.discard(session.id)
            live.muted.discard(session.id)
            live.refresh()
        self.zone_nodes.end(session)
        self.prepared.pop(session.id, None)
        data = {"message": message}
        self.log.record(f"session.{word}", session.id, data, actor=actor, owner=session.owner)
        self._touched[session.id] = self._clock_s()

    def _fail(self, session: SessionRecord, message: str) -> None:
        self._end(session, "failed", "service", message)

    def _forget(self, session: SessionRecord) -> None:
        self._tell(session, "forgotten", {})
        del self._touched[session.id]

    def _empty(self, name: str) -> None:
        live = self.live[name]
        live.hosted.clear()
        live.muted.clear()
        live.zones_of.clear()
        live.use = None
        live.refresh()

    def _tell(self, session: SessionRecord, word: str, data: dict[str, Any]) -> None:
        is_nodes = word in ("saved", "result", "handed_over")
        actor = session.node if is_nodes and session.node else "service"
        self.log.record(f"session.{word}", session.id, data, actor=actor, owner=session.owner)

    def _job_of(self, number: str) -> dict[str, Any]:
        session = self.log.state.sessions[number]
        return {"id": number, "configuration": session.configuration, **(session.job or {})}
