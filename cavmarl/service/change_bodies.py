"""Bodies of the commands that change the worlds of a session between two steps."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

MOST_LANES = 64  # lanes of one road
MOST_PARAMS = 64  # parameters of a scenario

Id = Annotated[str, StringConstraints(min_length=1, max_length=256)]  # id of a lane or road
Finite = Annotated[float, Field(allow_inf_nan=False)]
World = Annotated[int, Field(ge=0, lt=1024)]
Lanes = Annotated[list[Annotated[int, Field(ge=0, lt=MOST_LANES)]], Field(max_length=MOST_LANES)]
Plain = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_]{1,64}$")]  # never a path
# without "commands": only a single world can be recorded with them
Table = Literal["observations", "samples", "messages"]


class _Change(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class InsertVehicle(_Change):
    """Let a car enter a world; see `insert_vehicle` of an environment."""

    kind: Literal["insert_vehicle"]
    lane: Id
    position_m: Finite
    world: World = 0


class CloseRoad(_Change):
    """Close lanes of a road; see `close_road` of an environment."""

    kind: Literal["close_road"]
    edge: Id
    lanes: Lanes | None = None
    world: World = 0
    shuts_in: bool = False


class OpenRoad(_Change):
    """Open lanes of a closed or damaged road; see `open_road` of an environment."""

    kind: Literal["open_road"]
    edge: Id
    lanes: Lanes | None = None
    world: World = 0


class DamageRoad(_Change):
    """Lower the speed limit of lanes of a road; see `damage_road` of an environment."""

    kind: Literal["damage_road"]
    edge: Id
    speed_mps: Finite
    lanes: Lanes | None = None
    world: World = 0


class DeclareEvent(_Change):
    """Let the vehicle of an agent announce an event; see `declare_event` of an environment."""

    kind: Literal["declare_event"]
    agent: Annotated[int, Field(ge=0, lt=100_000)]  # index in `agents`
    cause: Plain
    world: World = 0


class SetScenario(_Change):
    """Recreate the worlds with or without a scenario; the next command must be a reset."""

    kind: Literal["scenario"]
    name: Annotated[str, StringConstraints(pattern=r"^[a-z0-9_]{0,64}$")]  # empty: none
    place: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_+:#,() -]{0,64}$")] = ""
    seed: Annotated[int, Field(ge=0, lt=1 << 53)] = 0
    params: Annotated[dict[Plain, bool | Finite], Field(max_length=MOST_PARAMS)] = {}


class BeginRecording(_Change):
    """Record the worlds from the next command on."""

    kind: Literal["record"]
    include: Annotated[list[Table], Field(max_length=3)] = []


Change = Annotated[
    InsertVehicle | CloseRoad | OpenRoad | DamageRoad | DeclareEvent | SetScenario | BeginRecording,
    Field(discriminator="kind"),
]


class KeptRecording(_Change):
    """The data of a recording in a saved state; each saved state ends a part of the recording."""

    include: Annotated[list[Table], Field(max_length=3)]
    part: Annotated[int, Field(ge=0, lt=1 << 31)]  # number of the next part


class KeptSession(_Change):
    """The part of a session's saved state that is not the state of its worlds."""

    begun_anew: list[bool]  # by world: whether a web page restarted it after the last command
    scenario: SetScenario | None  # None: the scenario of the configuration
    recording: KeptRecording | None
