"""Bodies of requests. Unknown fields, wrong types and values out of range are refused."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from cavmarl.core.seeds import SEED_BITS
from cavmarl.service.service_records import Role

Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
Word = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]{0,63}$")]
Host = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9:][A-Za-z0-9:.-]{0,254}$")]
Subject = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,127}$")]
Place = Annotated[  # relative path of a file
    str,
    StringConstraints(
        pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}(/[A-Za-z0-9][A-Za-z0-9_.-]{0,63}){0,2}$"
    ),
]
Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
Text = Annotated[str, StringConstraints(max_length=200)]
Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]
Port = Annotated[int, Field(ge=1, le=65535)]
Whole = Annotated[int, Field(ge=0, lt=1 << 53)]  # JSON represents these integers exactly
Seed = Annotated[int, Field(ge=0, lt=1 << SEED_BITS)]  # some JSON parsers round it
Words = Annotated[list[Word], Field(max_length=64)]


NO_OTHERS: Any = {"additionalProperties": False}  # refuse keys that do not match the pattern
MOST_WORLDS = 1024  # worlds of a session
MAX_WAIT_S = 7 * 86_400.0  # largest `wait_s` of a job


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class NodeBody(_Body):
    """Registration of a node."""

    name: Name
    address: Host
    client_port: Port
    simulator_port: Port
    slots: Annotated[int, Field(ge=1, le=10_000)] = 4
    capabilities: Words = []
    versions: Annotated[dict[Word, Word], Field(max_length=32, json_schema_extra=NO_OTHERS)] = {}
    allowed: Words = []


class BeatBody(_Body):
    """Heartbeat of a node. Shares of used resources are from 0 to 1: 0.85, not 85."""

    incarnation: Annotated[int, Field(ge=1)]
    sequence: Annotated[int, Field(ge=0)]
    cpu: Share
    ram: Share
    gpu: Share = 0.0
    sent_s: Annotated[float, Field(allow_inf_nan=False)]
    counters: Annotated[
        dict[Word, Annotated[float, Field(allow_inf_nan=False)]],
        Field(max_length=32, json_schema_extra=NO_OTHERS),
    ] = {}
    watched: bool = False  # a page of a session is open; the answer then has all LoadScores
    # job → steps done, total
    jobs: Annotated[
        dict[Word, Annotated[list[Whole], Field(min_length=2, max_length=2)]],
        Field(max_length=10_000, json_schema_extra=NO_OTHERS),
    ] = {}


class ConfigurationBody(_Body):
    """A world, with the keywords of `cavmarl.make_vec`.

    `files` are artefacts of the caller, by relative path. If they include `env.yaml`, or the map
    that `environment` names, they are the environment. `drivers/NAME/` has the two files of the
    driver NAME.
    """

    name: Name | None = None
    environment: Name
    agents: Annotated[int, Field(ge=0, le=100_000)] | None = None
    background: Annotated[int, Field(ge=0, le=100_000)] | None = None
    max_cycles: Annotated[int, Field(ge=1, le=10_000_000)] | None = None
    zones: Annotated[int, Field(ge=1, le=1024)] | None = None
    nodes: Annotated[int, Field(ge=1, le=64)] | None = (
        None  # number of nodes that host the zones; None: one
    )
    num_envs: Annotated[int, Field(ge=1, le=MOST_WORLDS)] = 1
    seed: Seed = 0
    overrides: Annotated[dict[str, Any], Field(max_length=256)] = {}
    files: Annotated[dict[Place, Sha256], Field(max_length=256, json_schema_extra=NO_OTHERS)] = {}


class SessionBody(_Body):
    """A client's request for a world."""

    configuration: Sha256
    node: Name | None = None
    needs: Words = []
    wait_s: Annotated[float, Field(ge=0.0, le=60.0)] = 0.0


class ResolveBody(_Body):
    """A client's request for the node and the token of its session."""

    unreachable: Annotated[list[Name], Field(max_length=16)] = []
    wait_s: Annotated[float, Field(ge=0.0, le=60.0)] = 0.0


class TransfersBody(_Body):
    """Vehicles of a session that have changed zone, or whose change is prepared."""

    at: Whole  # number of commands up to the report
    # world, episode, tick, vehicle, source, target, epoch
    transfers: Annotated[
        list[Annotated[list[Whole], Field(min_length=7, max_length=7)]], Field(max_length=2000)
    ] = []
    # world, vehicle, source, target; the target has the state, the source still owns it
    prepared: Annotated[
        list[Annotated[list[Whole], Field(min_length=4, max_length=4)]], Field(max_length=2000)
    ] = []


class DoorBody(_Body):
    """Address and key at which a node waits for the nodes that host zones of a session."""

    host: Host
    port: Port
    key: Sha256


class JobBody(_Body):
    """A client's request for an evaluation."""

    configuration: Sha256
    policies: Annotated[list[Name], Field(min_length=1, max_length=16)] = ["idm"]
    episodes: Annotated[int, Field(ge=1, le=100_000)] = 32
    repeats: Annotated[int, Field(ge=1, le=1000)] = 1
    node: Name | None = None
    needs: Words = []
    # longest wait for the first node in s; None: no limit
    wait_s: Annotated[float, Field(ge=0.0, le=MAX_WAIT_S)] | None = None


class TrainingBody(_Body):
    """A client's request for a training with `train/ppo.py`, in worlds with a configuration.

    `settings` are settings of the program that differ from their defaults.
    """

    configuration: Sha256
    settings: Annotated[
        dict[Word, bool | int | Annotated[float, Field(allow_inf_nan=False)] | Text],
        Field(max_length=64, json_schema_extra=NO_OTHERS),
    ] = {}
    node: Name | None = None
    needs: Annotated[list[Word], Field(max_length=63)] = []
    # longest wait for the first node in s; None: no limit
    wait_s: Annotated[float, Field(ge=0.0, le=MAX_WAIT_S)] | None = None


class OutcomeBody(_Body):
    """The outcome of a job."""

    status: Literal["done", "failed"]
    message: Annotated[str, StringConstraints(max_length=2000)] = ""


class IdentityBody(_Body):
    """A new identity. The answer has its secret, which is not shown again."""

    name: Name
    role: Role


class SecretBody(_Body):
    """A secret in exchange for tokens."""

    secret: Annotated[str, StringConstraints(max_length=256)]


class RefreshBody(_Body):
    """A refresh token in exchange for new tokens."""

    refresh_token: Annotated[str, StringConstraints(max_length=4096)]
