"""What the service knows: nodes, sessions, identities, keys and configurations.

All of it follows from the event log: `Infrastructure.apply` is the one place where it changes, so
that a replay of the log gives the same again. What nodes tell with each beat is not in it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

ROLES = ("viewer", "client", "operator", "admin", "node")
Role = Literal["viewer", "client", "operator", "admin", "node"]

SessionState = Literal["queued", "active", "closed", "done", "failed"]
SESSION_OVER = ("closed", "done", "failed")
KEPT_OWNERS = 10_000  # of a world


class LogEvent(NamedTuple):
    """One line of the log."""

    sequence: int  # from 1
    time_s: float  # of the wall clock
    kind: str
    actor: str  # id of the identity that caused it; `service`: none did
    subject: str  # what it is about: a node, a session, an identity, a configuration
    owner: str  # identity that owns the subject, and may read of it
    data: dict[str, Any]  # what may be shown
    private: dict[str, Any]  # hashes of secrets and keys: never shown
    digest: str  # over this line and the digest of the line before


@dataclass
class NodeRecord:
    """A node as it has registered itself."""

    name: str
    identity: str  # that registered it, and alone may speak for it
    incarnation: int  # how often it has registered
    address: str
    client_port: int
    simulator_port: int
    slots: int  # sessions and jobs that it takes at most
    capabilities: list[str]
    versions: dict[str, str]
    allowed: list[str]  # names of identities that it serves; none: all
    state: Literal["up", "down", "left"] = "up"
    draining: bool = False
    excluded: list[str] = field(default_factory=list)  # resources above their thresholds


@dataclass
class SessionRecord:
    """A session of a client, or a job: an evaluation that a node runs alone."""

    id: str
    owner: str
    owner_name: str
    configuration: str  # hash
    job: dict[str, Any] | None  # policy, episodes, repeats; None: a client steps the world
    needs: list[str]  # capabilities
    preferred: str | None  # name of a node
    opened_s: float = 0.0  # by the wall clock
    wait_s: float | None = None  # so long a job waits for its first node; None: as long as it takes
    state: SessionState = "queued"
    node: str | None = None
    incarnation: int = 0  # of that node
    placements: int = 0
    reason: str = ""  # why it is that node
    score: float = 0.0  # of that node, then
    excluded: list[dict[str, Any]] = field(default_factory=list)  # some of the others, and why
    excluded_count: int = 0
    saved_number: int = 0  # commands that the saved state includes
    saved_blob: str | None = None
    results: dict[str, str] = field(default_factory=dict)  # name → hash
    message: str = ""
    key: str = ""  # by which the same request is known again
    zone_nodes: int = 0  # how many nodes host the zones of its worlds; 0: its node has all
    members: list[str] = field(default_factory=list)  # these nodes
    told_number: int = 0  # commands up to which it is told which vehicles have changed their zone
    # world → its episode, and vehicle → [zone that owns it, epoch], of those that have changed
    owners: dict[str, OwnerTable] = field(default_factory=dict)


@dataclass
class OwnerTable:
    """Owners of the vehicles of one world that have changed their zone, the newest last."""

    episode: int
    zones: dict[int, list[int]] = field(default_factory=dict)


@dataclass
class IdentityRecord:
    """A person, a program or a node that may ask."""

    id: str
    name: str
    role: Role
    digest: str  # of its secret
    generation: int = 0  # tokens of earlier ones are void
    revoked: bool = False
    used: dict[str, float] = field(default_factory=dict)  # refresh tokens: id → when they expire


@dataclass
class Infrastructure:
    """Everything that follows from the log."""

    nodes: dict[str, NodeRecord] = field(default_factory=dict)
    sessions: dict[str, SessionRecord] = field(default_factory=dict)
    identities: dict[str, IdentityRecord] = field(default_factory=dict)
    keys: dict[str, str] = field(default_factory=dict)  # id → private key, in order of making
    configurations: dict[str, list[str]] = field(default_factory=dict)  # name → hashes, by version
    # identities → how many configurations they have added
    configurations_of: dict[str, int] = field(default_factory=dict)
    waiting: dict[str, None] = field(default_factory=dict)  # jobs that no node has, in their order

    def apply(self, event: LogEvent) -> None:
        """Change as `event` says; it has been checked before it was written."""
        topic, _, word = event.kind.partition(".")
        getattr(self, f"_apply_{topic}")(word, event)

    def _apply_identity(self, word: str, event: LogEvent) -> None:
        if word == "added":
            self.identities[event.subject] = IdentityRecord(
                id=event.subject, **event.data, **event.private
            )
            return
        identity = self.identities[event.subject]
        if word == "refreshed":
            now_s = event.time_s
            kept = {one: until_s for one, until_s in identity.used.items() if until_s > now_s}
            identity.used = kept | {event.data["token"]: event.data["expires_s"]}
            return
        identity.generation += 1  # `withdrawn`: its tokens; `revoked`: itself
        identity.revoked = identity.revoked or word == "revoked"

    def _apply_key(self, word: str, event: LogEvent) -> None:
        self.keys[event.subject] = event.private["pem"]

    def _apply_configuration(self, word: str, event: LogEvent) -> None:
        self.configurations.setdefault(event.subject, []).append(event.data["hash"])
        self.configurations_of[event.owner] = self.configurations_of.get(event.owner, 0) + 1

    def _apply_clock(self, word: str, event: LogEvent) -> None:
        """A clock's anomaly changes nothing."""

    def _apply_node(self, word: str, event: LogEvent) -> None:
        if word == "registered":
            self._lose(event.subject)  # what an earlier process of it had is gone
            self.nodes[event.subject] = NodeRecord(event.subject, **event.data)
            return
        if word == "forgotten":
            del self.nodes[event.subject]
            for session in self.sessions.values():
                session.members = [one for one in session.members if one != event.subject]
            return
        node = self.nodes[event.subject]
        match word:
            case "down" | "left":
                node.state = "down" if word == "down" else "left"
                self._lose(event.subject)
            case "up":
                node.state = "up"
            case "drained":
                node.draining = True
            case "resumed":
                node.draining = False
            case "overloaded" | "admissible":
                node.excluded = event.data.get("resources", [])

    def _lose(self, name: str) -> None:
        """Sessions of a node that is gone wait for another."""
        for session in self.sessions.values():
            if session.node == name and session.state == "active":
                session.node, session.state = None, "queued"
                if session.job is not None:
                    self.waiting[session.id] = None

    def _apply_session(self, word: str, event: LogEvent) -> None:
        if word == "opened":
            self.sessions[event.subject] = SessionRecord(
                id=event.subject, owner=event.owner, opened_s=event.time_s, **event.data
            )
            if event.data["job"] is not None:
                self.waiting[event.subject] = None
            return
        if word in ("refused", "timeout"):  # what comes of it is told beside it
            return
        if word == "forgotten":
            del self.sessions[event.subject]
            return
        session = self.sessions[event.subject]
        match word:
            case "assigned" | "redirected":
                session.node, session.incarnation = event.data["node"], event.data["incarnation"]
                session.reason, session.score = event.data["reason"], event.data["score"]
                session.excluded = event.data["excluded"]
                session.excluded_count = event.data["excluded_count"]
                session.state = "active"
                self.waiting.pop(event.subject, None)
                session.placements += 1
            case "saved":
                session.saved_number = event.data["number"]
                session.saved_blob = event.data["sha256"]
            case "repartitioned":
                session.members = event.data["members"]
            case "handed_over":
                session.told_number = event.data["number"]
                for transfer in event.data["transfers"]:
                    _hand_over(session.owners, *transfer)
            case "result":
                session.results[event.data["name"]] = event.data["sha256"]
            case "closed" | "done" | "failed":
                session.state, session.node = word, None
                self.waiting.pop(event.subject, None)
                session.saved_blob, session.message = None, event.data.get("message", "")


def _hand_over(
    owners: dict[str, OwnerTable],
    world: int,
    episode: int,
    tick: int,
    vehicle: int,
    source: int,
    target: int,
    epoch: int,
) -> None:
    table = owners.get(str(world))
    if table is None or table.episode != episode:
        table = owners[str(world)] = OwnerTable(episode)
    table.zones.pop(vehicle, None)
    table.zones[vehicle] = [target, epoch]
    if len(table.zones) > KEPT_OWNERS:
        del table.zones[next(iter(table.zones))]
