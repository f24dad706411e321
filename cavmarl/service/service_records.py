"""The records of the service: nodes, sessions, identities, keys and configurations.

All records follow from the event log: only `Infrastructure.apply` changes them, so replaying the
log gives the same records again. Values of heartbeats are not part of the log.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

Role = Literal["viewer", "client", "operator", "admin", "node"]
ROLES: tuple[Role, ...] = ("viewer", "client", "operator", "admin", "node")

SessionState = Literal["queued", "active", "closed", "done", "failed"]
STATE_HEADER = "Cavmarl-State"  # header with the service's signature of a state
SESSION_OVER = ("closed", "done", "failed")
KEPT_OWNERS = 10_000  # maximum number of owners that are kept for each world


class LogEvent(NamedTuple):
    """One line of the log."""

    sequence: int  # from 1
    time_s: float  # wall-clock time
    kind: str
    actor: str  # identity that caused the event, or `service`
    subject: str  # name or id of a node, session, identity or configuration
    owner: str  # identity that owns the subject and may read the event
    data: dict[str, Any]  # public data
    private: dict[str, Any]  # private data: hashes of secrets, keys
    digest: str  # digest of this line and of the previous line's digest


@dataclass
class NodeRecord:
    """A node as registered."""

    name: str
    identity: str  # identity that registered the node and alone may act for it
    incarnation: int  # number of registrations
    address: str
    client_port: int
    simulator_port: int
    slots: int  # maximum number of sessions and jobs
    capabilities: list[str]
    versions: dict[str, str]
    allowed: list[str]  # names of the identities that it serves; empty: all
    state: Literal["up", "down", "left"] = "up"
    draining: bool = False
    excluded: list[str] = field(default_factory=list)  # resources above their thresholds


@dataclass
class SessionRecord:
    """A session of a client, or a job: an evaluation or training that runs without a client."""

    id: str
    owner: str
    owner_name: str
    configuration: str  # hash
    job: dict[str, Any] | None  # an evaluation or a training; None: a session of a client
    needs: list[str]  # capabilities
    preferred: str | None  # name of a node
    opened_s: float = 0.0  # wall-clock time
    wait_s: float | None = None  # longest wait of a job for its first node in s; None: no limit
    state: SessionState = "queued"
    node: str | None = None
    incarnation: int = 0  # incarnation of `node`
    placements: int = 0  # how often it was assigned to a node
    losses: int = 0  # times that its node was lost or left since its state was last saved
    reason: str = ""  # why that node was chosen
    score: float = 0.0  # LoadScore of that node when it was chosen
    excluded: list[dict[str, Any]] = field(
        default_factory=list
    )  # some excluded nodes, with reasons
    excluded_count: int = 0  # number of all excluded nodes
    saved_number: int = 0  # commands that the saved state includes
    saved_blob: str | None = None  # hash of the saved state
    results: dict[str, str] = field(default_factory=dict)  # name → hash
    message: str = ""
    key: str = ""  # key that identifies a repeated request
    zone_nodes: int = 0  # number of nodes that host its zones; 0: its own node hosts all
    members: list[str] = field(default_factory=list)  # names of the nodes that host its zones
    told_number: int = 0  # number of commands up to the last report of transfers
    # world → episode, and vehicle → [owner, epoch] of vehicles that changed zone
    owners: dict[str, OwnerTable] = field(default_factory=dict)


@dataclass
class OwnerTable:
    """Owners of the vehicles of one world that have changed zone, newest last."""

    episode: int
    zones: dict[int, list[int]] = field(default_factory=dict)


@dataclass
class ArtefactRecord:
    """A file that an identity has stored."""

    name: str  # the suffix states the kind of file
    licence: str
    size_bytes: int
    until_s: float  # wall-clock time at which it is deleted unless it is used


@dataclass
class IdentityRecord:
    """A person, a program or a node with access to the service."""

    id: str
    name: str
    role: Role
    digest: str  # hash of the secret
    generation: int = 0  # tokens of earlier generations are invalid
    revoked: bool = False
    used: dict[str, float] = field(default_factory=dict)  # refresh tokens: id → when they expire


@dataclass
class Infrastructure:
    """All records that follow from the log."""

    nodes: dict[str, NodeRecord] = field(default_factory=dict)
    sessions: dict[str, SessionRecord] = field(default_factory=dict)
    identities: dict[str, IdentityRecord] = field(default_factory=dict)
    keys: dict[str, str] = field(default_factory=dict)  # id → private key, oldest first
    configurations: dict[str, list[str]] = field(default_factory=dict)  # name → hashes, by version
    # identity → number of configurations added
    configurations_of: dict[str, int] = field(default_factory=dict)
    # hash of a configuration → hashes of its files, if it has files
    files: dict[str, list[str]] = field(default_factory=dict)
    # identity → hash → file
    artefacts: dict[str, dict[str, ArtefactRecord]] = field(default_factory=dict)
    waiting: dict[str, None] = field(
        default_factory=dict
    )  # jobs without a node, in order of arrival
    # hash of content → number of configurations, artefacts, states and results that refer to it
    users: Counter[str] = field(default_factory=Counter)
    # content without references that `take_unused` has not returned yet
    unused: set[str] = field(default_factory=set, compare=False)

    def take_unused(self) -> set[str]:
        """Return the content that has lost its last reference since the last call."""
        found, self.unused = self.unused, set()
        return found

    def _replace_user(self, new: str | None, old: str | None) -> None:
        """Count one more reference to content `new`, and one less to `old`. None: no content."""
        if new is not None:
            self.users[new] += 1
            self.unused.discard(new)
        if old is not None:
            self.users[old] -= 1
            if not self.users[old]:
                del self.users[old]
                self.unused.add(old)

    def files_of(self, configuration: str) -> list[str]:
        """Return the hashes of the files of a configuration."""
        return self.files.get(configuration, [])

    def apply(self, event: LogEvent) -> None:
        """Apply an event that was checked before it was written."""
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
        # `withdrawn`: the identity's tokens become invalid; `revoked`: the identity itself, too
        identity.generation += 1
        identity.revoked = identity.revoked or word == "revoked"

    def _apply_key(self, word: str, event: LogEvent) -> None:
        self.keys[event.subject] = event.private["pem"]

    def _apply_configuration(self, word: str, event: LogEvent) -> None:
        self.configurations.setdefault(event.subject, []).append(event.data["hash"])
        self._replace_user(event.data["hash"], None)
        self.configurations_of[event.owner] = self.configurations_of.get(event.owner, 0) + 1
        if files := event.data.get("files"):
            self.files[event.data["hash"]] = files

    def _apply_artefact(self, word: str, event: LogEvent) -> None:
        own = self.artefacts.setdefault(event.owner, {})
        match word:
            case "added":
                if event.subject not in own:
                    self._replace_user(event.subject, None)
                data = event.data
                own[event.subject] = ArtefactRecord(
                    data["name"], data["licence"], data["bytes"], data["until_s"]
                )
            case "used":
                own[event.subject].until_s = event.data["until_s"]
            case "deleted" | "expired":
                del own[event.subject]
                self._replace_user(None, event.subject)

    def _apply_service(self, word: str, event: LogEvent) -> None:
        """Change nothing: the start of a service and its rules are only logged."""

    def _apply_clock(self, word: str, event: LogEvent) -> None:
        """Change nothing: an anomaly of a clock is only logged."""

    def _apply_node(self, word: str, event: LogEvent) -> None:
        if word == "registered":
            self._lose(event.subject)  # the sessions of an earlier process of the node are lost
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
        """Let the sessions of a lost node wait for another one."""
        for session in self.sessions.values():
            if session.node == name and session.state == "active":
                session.node, session.state = None, "queued"
                session.losses += 1
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
        if word in ("refused", "timeout"):  # changes no record
            return
        if word == "forgotten":
            for sha256 in self.sessions.pop(event.subject).results.values():
                self._replace_user(None, sha256)
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
                self._replace_user(event.data["sha256"], session.saved_blob)
                session.saved_number, session.losses = event.data["number"], 0
                session.saved_blob = event.data["sha256"]
            case "repartitioned":
                session.members = event.data["members"]
            case "handed_over":
                session.told_number = event.data["number"]
                for transfer in event.data["transfers"]:
                    _hand_over(session.owners, *transfer)
            case "result":
                name, sha256 = event.data["name"], event.data["sha256"]
                self._replace_user(sha256, session.results.get(name))
                session.results[name] = sha256
            case "closed" | "done" | "failed":
                session.state, session.node = word, None
                self.waiting.pop(event.subject, None)
                self._replace_user(None, session.saved_blob)
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
