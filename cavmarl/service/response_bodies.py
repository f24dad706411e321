"""Responses, as the OpenAPI document shows them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from cavmarl.service.request_bodies import ConfigurationBody, Sha256
from cavmarl.service.service_records import Role


class _Answer(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Health(_Answer):
    """The service is running."""

    status: Literal["ok"]
    events: int  # number of events in the log


class PublicKey(_Answer):
    """An Ed25519 key as in RFC 8037."""

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
    """Tokens. Send the access token as `Authorization: Bearer TOKEN`."""

    access_token: str
    refresh_token: str  # can be used once
    token_type: Literal["Bearer"]
    expires_in: float  # seconds
    role: Role
    identity: str


class Load(_Answer):
    """Shares of used resources, from 0 to 1."""

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
    limits: list[str]  # why it accepts no session, with the limit and what to do
    load: Load | None  # null: no heartbeat yet
    score: float | None
    sessions: int
    zones_of: list[str]  # sessions with zones on this node, once per part of the zones
    age_s: float  # seconds since the last heartbeat


class Excluded(_Answer):
    """A node that was not chosen, and the reason."""

    node: str
    reason: str
    value: float | None = None
    threshold: float | None = None


class NodeList(_Answer):
    """All nodes."""

    nodes: list[NodeStatus]


class Door(_Answer):
    """The address at which a node must connect to host zones of a session."""

    session: str
    host: str
    port: int
    key: str


class JobOrder(_Answer):
    """An evaluation that a node must run."""

    id: str
    configuration: Sha256
    policies: list[str]
    episodes: int
    repeats: int


class TrainingOrder(_Answer):
    """A training that a node must run."""

    id: str
    configuration: Sha256
    settings: dict[str, bool | int | float | str]


class NodeScore(_Answer):
    """A node as pages show it."""

    name: str
    state: str
    score: float | None  # null: the node reports no load
    sessions: int


class Duties(_Answer):
    """The tasks of a node."""

    draining: bool
    beat_s: float
    sessions: list[str]
    zones_of: list[Door]
    without_door: list[str]
    jobs: list[JobOrder | TrainingOrder]
    scores: list[NodeScore]  # the first hundred nodes by name, if a page is open


class Configuration(ConfigurationBody):
    """A stored configuration."""

    hash: Sha256
    version: int
    name: str


class Assignment(_Answer):
    """Where the worlds of a session are, and the token that opens them."""

    session: str
    requested: str | None
    assigned: str
    redirected: bool
    reason: str
    score: float
    excluded: list[Excluded]  # the first nodes that were excluded
    excluded_count: int
    scheme: Literal["http", "https"]
    address: str
    client_port: int
    simulator_port: int
    configuration: Sha256
    lease_s: float
    expires_s: float  # wall-clock time
    token: str


class Job(_Answer):
    """An evaluation."""

    policies: list[str]
    episodes: int
    repeats: int


class Training(_Answer):
    """A training."""

    settings: dict[str, bool | int | float | str]


class Session(_Answer):
    """A session, or a job if `job` is set."""

    id: str
    owner: str
    owner_name: str
    configuration: Sha256
    job: Job | Training | None
    needs: list[str]
    preferred: str | None
    wait_s: float | None  # longest wait of a job for its first node
    opened_s: float  # wall-clock time
    state: Literal["queued", "active", "closed", "done", "failed"]
    node: str | None
    incarnation: int
    placements: int
    reason: str
    score: float
    excluded: list[Excluded]
    excluded_count: int
    saved_number: int
    results: dict[str, str]  # names of files → hashes
    message: str
    key: str
    zone_nodes: int
    members: list[str]
    told_number: int
    progress: list[int] | None  # steps of a job: done, total; null: not reported yet
    waits_for: str  # why no node takes a queued job; empty: unknown


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
    """A vehicle whose change of zone is prepared."""

    world: int
    vehicle: int
    source: int
    target: int
    state: Literal["PREPARED"]


class Ownership(_Answer):
    """Owners of the vehicles that have changed zone."""

    number: int  # number of commands up to the last report
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
    data: dict[str, Any]  # its keys depend on `kind`
    digest: str


class EventList(_Answer):
    """Lines of the log, oldest first."""

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
    """An identity and its secret, which is not shown again."""

    identity: str
    name: str
    role: Role
    secret: str


class NewKey(_Answer):
    """The new signing key."""

    key: str


class Artefact(_Answer):
    """A file that an identity has stored."""

    sha256: Sha256
    owner: str
    name: str
    licence: str
    size_bytes: int
    until_s: float  # wall-clock time at which it is deleted unless it is used


class ArtefactList(_Answer):
    """Files that identities have stored."""

    artefacts: list[Artefact]


class ArrayForm(_Answer):
    """Form of an array; `dtype` is written as in NumPy, for example `<f4`."""

    shape: list[int]
    dtype: str


class WorldDescription(_Answer):
    """The worlds of a session on their node."""

    number: int  # number of commands so far; the next command has the next number
    saved: int  # number of commands that the saved state includes
    agents: list[str]
    num_envs: int
    max_cycles: int
    step_s: float
    action: ArrayForm
    observation: ArrayForm


class WorldHashes(_Answer):
    """State hashes of the worlds of a session."""

    hashes: list[str]


class WorldPage(_Answer):
    """Address of a page on the node's machine that shows and controls the worlds."""

    address: str
    token: str  # token to control the worlds; to watch them if they cannot be saved
    watch_token: str  # token to watch only


class WorldTransfers(_Answer):
    """Ownership transfers of divided worlds."""

    transfers: list[dict[str, Any]]
