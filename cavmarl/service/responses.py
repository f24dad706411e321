"""The answers to requests, as the document of the interface shows them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from cavmarl.service.requests import ConfigurationBody, Sha256
from cavmarl.service.service_records import Role


class _Answer(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Health(_Answer):
    """The service is there."""

    status: Literal["ok"]
    events: int  # in the log


class PublicKey(_Answer):
    """A key of Ed25519, as RFC 8037 has it."""

    kid: str
    kty: Literal["OKP"]
    crv: Literal["Ed25519"]
    x: str
    alg: Literal["EdDSA"]
    use: Literal["sig"]


class PublicKeys(_Answer):
    """A JSON Web Key Set."""

    keys: list[PublicKey]


class Tokens(_Answer):
    """Send the access token as `Authorization: Bearer TOKEN`."""

    access_token: str
    refresh_token: str  # good once
    token_type: Literal["Bearer"]
    expires_in: float  # seconds
    role: Role
    identity: str


class Load(_Answer):
    """Shares in use, from 0 to 1."""

    cpu: float
    ram: float
    gpu: float


class NodeStatus(_Answer):
    """A node."""

    name: str
    identity: str
    incarnation: int
    address: str
    client_port: int
    simulator_port: int
    slots: int
    capabilities: list[str]
    versions: dict[str, str]
    allowed: list[str]
    state: Literal["up", "down", "left"]
    draining: bool
    excluded: list[str]  # resources above their thresholds
    load: Load | None  # null: no beat yet
    score: float | None
    sessions: int
    zones_of: list[str]  # sessions whose zones it hosts, one for each part
    age_s: float  # since it was heard of


class Excluded(_Answer):
    """A node that was not chosen, and why."""

    node: str
    reason: str
    value: float | None = None
    threshold: float | None = None


class NodeList(_Answer):
    """All nodes."""

    nodes: list[NodeStatus]


class Door(_Answer):
    """Where a node has to call, to host zones of a session."""

    session: str
    host: str
    port: int
    key: str


class JobOrder(_Answer):
    """What a node has to evaluate."""

    id: str
    configuration: Sha256
    policies: list[str]
    episodes: int
    repeats: int


class NodeScore(_Answer):
    """A node as pages show it."""

    name: str
    state: str
    score: float | None  # null: it has told no load
    sessions: int


class Duties(_Answer):
    """What a node has to do."""

    draining: bool
    beat_s: float
    sessions: list[str]
    zones_of: list[Door]
    without_door: list[str]
    jobs: list[JobOrder]
    scores: list[NodeScore]  # of the first hundred nodes by name, if a page is open


class Configuration(ConfigurationBody):
    """A configuration that is kept."""

    hash: Sha256
    version: int
    name: str


class Assignment(_Answer):
    """Where the worlds of a session are, and what opens them there."""

    session: str
    requested: str | None
    assigned: str
    redirected: bool
    reason: str
    score: float
    excluded: list[Excluded]  # the first of those that were left out
    excluded_count: int
    scheme: Literal["http", "https"]
    address: str
    client_port: int
    simulator_port: int
    configuration: Sha256
    lease_s: float
    expires_s: float  # of the wall clock
    token: str


class Job(_Answer):
    """An evaluation."""

    policies: list[str]
    episodes: int
    repeats: int


class Session(_Answer):
    """A session, or a job: then `job` says what it evaluates."""

    id: str
    owner: str
    owner_name: str
    configuration: Sha256
    job: Job | None
    needs: list[str]
    preferred: str | None
    wait_s: float | None  # how long a job may wait for its first node
    opened_s: float  # of the wall clock
    state: Literal["queued", "active", "closed", "done", "failed"]
    node: str | None
    incarnation: int
    placements: int
    reason: str
    score: float
    excluded: list[Excluded]
    excluded_count: int
    saved_number: int
    results: dict[str, str]  # files, with their hashes
    message: str
    key: str
    zone_nodes: int
    members: list[str]
    told_number: int
    progress: list[int] | None  # of a job: steps done, and to be; null: its node has told none


class SessionList(_Answer):
    """Sessions and jobs."""

    sessions: list[Session]


class OwnerOfVehicle(_Answer):
    """The zone that owns a vehicle."""

    world: int
    episode: int
    vehicle: int
    zone: int
    epoch: int


class InFlight(_Answer):
    """A vehicle that is about to change its zone."""

    world: int
    vehicle: int
    source: int
    target: int
    state: Literal["PREPARED"]


class Ownership(_Answer):
    """Owners of vehicles that have changed their zone."""

    number: int  # commands up to which it is told
    owners: list[OwnerOfVehicle]
    in_flight: list[InFlight]


class EventLine(_Answer):
    """A line of the log."""

    sequence: int
    time_s: float
    kind: str
    actor: str
    subject: str
    owner: str
    data: dict[str, Any]  # by kind
    digest: str


class EventList(_Answer):
    """Lines of the log, the oldest first."""

    events: list[EventLine]


class Identity(_Answer):
    """An identity."""

    id: str
    name: str
    role: Role
    revoked: bool


class IdentityList(_Answer):
    """All identities."""

    identities: list[Identity]


class NewIdentity(_Answer):
    """An identity, and its secret, which is shown this once."""

    identity: str
    name: str
    role: Role
    secret: str


class NewKey(_Answer):
    """The key that signs from now on."""

    key: str


class ArrayForm(_Answer):
    """Of an array: `dtype` as numpy writes it, such as `<f4`."""

    shape: list[int]
    dtype: str


class WorldDescription(_Answer):
    """The worlds of a session, on their node."""

    number: int  # commands up to now: the next one has the number after it
    saved: int  # those that the saved state includes
    agents: list[str]
    num_envs: int
    max_cycles: int
    step_s: float
    action: ArrayForm
    observation: ArrayForm


class WorldHashes(_Answer):
    """Digests of the worlds of a session."""

    hashes: list[str]


class WorldPage(_Answer):
    """Where the worlds of a session can be watched and controlled, on the machine of their node."""

    address: str
    token: str  # that the page asks for, to control them; without a state to be saved, to watch
    watch_token: str  # to watch alone


class WorldTransfers(_Answer):
    """Changes of owner in divided worlds."""

    transfers: list[dict[str, Any]]
