"""The keys under `sensors` of `env.yaml`: what each sensor of an agent is set to.

Counts of 0 and empty lists switch a sensor off. `kinematics`, `occupancy_grid` and
`lidar_observation` take the names, the defaults and the meanings of highway-env's observations
(Leurent: "An environment for autonomous driving decision-making", 2018), so that a policy made for
those can be used here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, Self

from cavmarl.config.checks import Section, Whole, Within, check, check_finite
from cavmarl.core.extensions import REGISTERED_SENSORS

# highway-env's features of one vehicle, in the order of their codes in
# sensors/kernels/kinematics_observation.py.
VEHICLE_FEATURES = (
    "presence",
    "x",
    "y",
    "vx",
    "vy",
    "heading",
    "cos_h",
    "sin_h",
    "cos_d",
    "sin_d",
    "long_off",
    "lat_off",
    "ang_off",
)
# A layer of an occupancy grid shows one of them, or where the road is.
GRID_FEATURES = (*VEHICLE_FEATURES, "on_road")

# More numbers than this in one grid are a mistake: 100 agents would observe 26 MB a step.
MAX_GRID_NUMBERS = 65_536


@dataclass(frozen=True)
class SensorSection(Section, key=""):
    """The keys of one sensor.

    A class of a sensor names `switches`, the fields that switch it on: it is off if each of them is
    0, empty or false. `sight` are those switches that let it look at other vehicles or at signals.
    """

    switches: ClassVar[tuple[str, ...]] = ()
    sight: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(
        cls, key: str, switches: tuple[str, ...] = (), sight: tuple[str, ...] = ()
    ) -> None:
        super().__init_subclass__(key=key)
        cls.switches, cls.sight = switches, sight

    @property
    def is_on(self) -> bool:
        """Whether any of the switches is set."""
        return any(getattr(self, name) for name in self.switches)

    def without_sight(self) -> Self:
        """Return the same sensor with its sight switched off."""
        return replace(self, **{name: type(getattr(self, name))() for name in self.sight})


@dataclass(frozen=True)
class EgoConfig(SensorSection, key="sensors.ego", switches=("enabled",)):
    """The vehicle itself, its lane and what the plan asks of it.

    Attributes:
        enabled: false switches the sensor off.
        size: adds what its type can do: size, wheelbase, steering, acceleration, braking, speed.
    """

    enabled: bool = True
    size: bool = False


@dataclass(frozen=True)
class RouteAheadConfig(SensorSection, key="sensors.route", switches=("points",)):
    """Points of the route ahead, in the ego frame.

    Attributes:
        points: how many; 0 switches the sensor off.
        spacing_m: way between one and the next.
    """

    points: Annotated[int, Whole(0, 64)] = 8
    spacing_m: Annotated[float, Within(0.5, 100.0)] = 6.0


@dataclass(frozen=True)
class NeighborsConfig(
    SensorSection, key="sensors.neighbors", switches=("count",), sight=("count",)
):
    """The nearest vehicles, in the ego frame.

    Attributes:
        count: how many at most; 0 switches the sensor off.
        range_m: distance up to which a vehicle is seen.
        through_walls: false hides vehicles whose centre lies behind a wall of `map.buildings`.
    """

    count: Annotated[int, Whole(0, 64)] = 8
    range_m: Annotated[float, Within(1.0, 300.0)] = 60.0
    through_walls: bool = True


@dataclass(frozen=True)
class SignalAheadConfig(
    SensorSection, key="sensors.signal", switches=("enabled",), sight=("enabled",)
):
    """The next signal or duty to give way on the route.

    Attributes:
        enabled: false switches the sensor off.
        range_m: how far ahead it is seen.
        timing: adds the time until the signal changes, as roadside units broadcast it.
    """

    enabled: bool = True
    range_m: Annotated[float, Within(1.0, 300.0)] = 80.0
    timing: bool = False


@dataclass(frozen=True)
class LanesConfig(SensorSection, key="sensors.lanes", switches=("range_m",), sight=("range_m",)):
    """Vehicles by their place along the lanes around, and the one that crosses the own way first.

    Attributes:
        range_m: how far along lanes a vehicle is seen; 0 switches the sensor off.
    """

    range_m: Annotated[float, Within(0.0, 300.0)] = 0.0


@dataclass(frozen=True)
class LidarConfig(SensorSection, key="sensors.lidar", switches=("rays",), sight=("rays",)):
    """Distances around the vehicle.

    Attributes:
        rays: how many, equally spaced; 0 switches the sensor off.
        range_m: how far a ray reaches.
        speeds: adds the relative speed of what each ray hits.
    """

    rays: Annotated[int, Whole(0, 1024)] = 64
    range_m: Annotated[float, Within(1.0, 300.0)] = 60.0
    speeds: bool = False


@dataclass(frozen=True)
class KinematicsConfig(
    SensorSection, key="sensors.kinematics", switches=("vehicles_count",), sight=("vehicles_count",)
):
    """highway-env's `Kinematics`: a table of vehicles by features, the own one first.

    Attributes:
        vehicles_count: rows, the own vehicle included (highway-env: 5); 0 switches the sensor off.
        features: columns, of `presence`, `x`, `y`, `vx`, `vy`, `heading`, `cos_h`, `sin_h`,
            `cos_d`, `sin_d`, `long_off`, `lat_off`, `ang_off`.
        features_range: feature to [min, max], which are mapped to [-1, 1]; features that are not
            named stay as they are. Empty: x ±200 m, y ±4 m for each lane of the map's widest road,
            vx and vy ±80 m/s.
        absolute: whether x, y, vx and vy of the others are the world's; else relative to the own
            ones. The own row always has the world's.
        order: `sorted`: nearest along the lane first. `shuffled`: the first by id, in random order.
        normalize: whether ranges are mapped to [-1, 1].
        clip: whether what was mapped is clipped to [-1, 1].
        see_behind: whether vehicles more than two lengths behind are seen.
        observe_intentions: whether `cos_d` and `sin_d` of the others are shown; else they are 0.
    """

    vehicles_count: Annotated[int, Whole(0, 256)] = 0
    features: tuple[str, ...] = ("presence", "x", "y", "vx", "vy")
    features_range: dict[str, tuple[float, ...]] = field(default_factory=dict)
    absolute: bool = False
    order: Literal["sorted", "shuffled"] = "sorted"
    normalize: bool = True
    clip: bool = True
    see_behind: bool = False
    observe_intentions: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        key = "sensors.kinematics"
        self.need("features", bool(self.features), "must name at least one")
        _check_features(f"{key}.features", self.features, VEHICLE_FEATURES)
        _check_ranges(f"{key}.features_range", self.features_range)


@dataclass(frozen=True)
class OccupancyGridConfig(
    SensorSection, key="sensors.occupancy_grid", switches=("features",), sight=("features",)
):
    """highway-env's `OccupancyGrid`: layers of cells around the vehicle.

    Attributes:
        features: layers, of `kinematics.features` and `on_road` (highway-env: presence, vx, vy,
            on_road); an empty list switches the sensor off.
        features_range: feature to [min, max], which are mapped to [-1, 1]. Empty: vx and vy
            ±80 m/s.
        grid_size_m: [[min x, max x], [min y, max y]] around the vehicle.
        grid_step_m: [x, y], sides of a cell.
        align_to_vehicle_axes: whether the cells turn with the vehicle.
        clip: whether all is clipped to [-1, 1].
        as_image: whether [-1, 1] is given as whole numbers from 0 to 255.
    """

    features: tuple[str, ...] = ()
    features_range: dict[str, tuple[float, ...]] = field(default_factory=dict)
    grid_size_m: tuple[tuple[float, ...], ...] = ((-27.5, 27.5), (-27.5, 27.5))
    grid_step_m: tuple[float, ...] = (5.0, 5.0)
    align_to_vehicle_axes: bool = False
    clip: bool = True
    as_image: bool = False

    def __post_init__(self) -> None:
        key = "sensors.occupancy_grid"
        _check_features(f"{key}.features", self.features, GRID_FEATURES)
        _check_ranges(f"{key}.features_range", self.features_range)
        self.need(
            "grid_size_m",
            len(self.grid_size_m) == 2 and all(_is_range(axis) for axis in self.grid_size_m),
            "must be [[min x, max x], [min y, max y]], both rising",
        )
        for axis in self.grid_size_m:
            for bound in axis:
                check_finite(f"{key}.grid_size_m", bound, -300.0, 300.0)
        self.need("grid_step_m", len(self.grid_step_m) == 2, "must be [x, y], the sides of a cell")
        for step in self.grid_step_m:
            check_finite(f"{key}.grid_step_m", step, 0.1, 300.0)
        columns, rows = self.shape
        self.need(
            "grid_step_m", columns >= 1 and rows >= 1, "must fit into grid_size_m at least once"
        )
        numbers = len(self.features) * columns * rows
        self.need(
            "grid_size_m",
            numbers <= MAX_GRID_NUMBERS,
            f"{len(self.features)} layers of {columns} by {rows} cells are {numbers} numbers, more "
            f"than {MAX_GRID_NUMBERS}; use larger grid_step_m or a smaller grid_size_m",
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Cells along x and along y."""
        columns, rows = (
            math.floor((high - low) / step)
            for (low, high), step in zip(self.grid_size_m, self.grid_step_m, strict=True)
        )
        return columns, rows


@dataclass(frozen=True)
class LidarObservationConfig(
    SensorSection, key="sensors.lidar_observation", switches=("cells",), sight=("cells",)
):
    """highway-env's `LidarObservation`: distance and speed in sectors around the vehicle.

    Attributes:
        cells: sectors (highway-env: 16); 0 switches the sensor off.
        maximum_range_m: how far it sees.
        normalize: whether distances and speeds are divided by `maximum_range_m`.
    """

    cells: Annotated[int, Whole(0, 1024)] = 0
    maximum_range_m: Annotated[float, Within(1.0, 300.0)] = 60.0
    normalize: bool = True


@dataclass(frozen=True)
class MessagesConfig(
    SensorSection, key="sensors.messages", switches=("objects", "events", "signal")
):
    """What the vehicle has been told over the air, see `v2x`.

    Attributes:
        objects: vehicles that it has heard of, the nearest ones; 0: none.
        events: that it has heard of, the nearest ones; 0: none.
        signal: adds what the roadside unit of the next signal on the route says.
        range_m: distance that a place of 1 stands for; what is further away has 1, too.
    """

    objects: Annotated[int, Whole(0, 64)] = 0
    events: Annotated[int, Whole(0, 64)] = 0
    signal: bool = False
    range_m: Annotated[float, Within(1.0, 10_000.0)] = 100.0


@dataclass(frozen=True)
class WayConfig(
    SensorSection, key="sensors.way", switches=("distances_m", "lines"), sight=("lines",)
):
    """The way ahead by its shape, its lanes and the stop lines on it.

    Attributes:
        distances_m: at which places are told, rising; an empty list: none.
        lines: next stop lines with a signal or a duty to give way that are told; 0: none.
        range_m: how far ahead a line is seen.
        timing: adds the time until a line's signal changes, as roadside units broadcast it.
    """

    distances_m: tuple[float, ...] = ()
    lines: Annotated[int, Whole(0, 8)] = 0
    range_m: Annotated[float, Within(1.0, 300.0)] = 100.0
    timing: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        distances = self.distances_m
        self.need(
            "distances_m",
            len(distances) <= 64
            and all(0.5 <= distance <= 300.0 for distance in distances)
            and all(a < b for a, b in pairwise(distances)),
            "must be rising distances from 0.5 to 300, 64 at most",
        )


@dataclass(frozen=True)
class ConflictsConfig(
    SensorSection, key="sensors.conflicts", switches=("count",), sight=("count",)
):
    """The vehicles that come nearest to the own way, the soonest and nearest ones first.

    Nothing of their plans is told but what `indicators` show: each is taken to go on as it goes,
    along its heading.

    Attributes:
        count: how many at most; 0 switches the sensor off.
        range_m: distance up to which a vehicle is seen.
        through_walls: false hides vehicles whose centre lies behind a wall of `map.buildings`.
        heard: true adds those that are not seen and that a message tells of (`v2x`), where they are
            if they have gone on as it says; and two numbers a vehicle, see `seen` and `age`.
        indicators: true takes vehicles that are seen to follow their lanes and the way that they
            indicate over the junction that they are on or come to next; and one number a vehicle,
            see `turn`.
    """

    count: Annotated[int, Whole(0, 64)] = 0
    range_m: Annotated[float, Within(1.0, 300.0)] = 60.0
    through_walls: bool = True
    heard: bool = False
    indicators: bool = False


@dataclass(frozen=True)
class HistoryConfig(SensorSection, key="sensors.history", switches=("steps",)):
    """What the vehicle was told to do, and its speeds.

    Attributes:
        steps: how many of the last ones; 0 switches the sensor off.
    """

    steps: Annotated[int, Whole(0, 64)] = 0


@dataclass(frozen=True)
class SensorsConfig(Section, key="sensors"):
    """The sensors of every agent; counts and ranges of 0 switch one off.

    Attributes:
        stack: observations in one: the last ones, oldest first. At first all are the first.
        registered: sensors from outside of the package that are on, by name
            (docs/guides/extending.md); their features follow those of all others.
    """

    stack: Annotated[int, Whole(1, 64)] = 1
    ego: EgoConfig = field(default_factory=EgoConfig)
    route: RouteAheadConfig = field(default_factory=RouteAheadConfig)
    neighbors: NeighborsConfig = field(default_factory=NeighborsConfig)
    signal: SignalAheadConfig = field(default_factory=SignalAheadConfig)
    lanes: LanesConfig = field(default_factory=LanesConfig)
    lidar: LidarConfig = field(default_factory=LidarConfig)
    kinematics: KinematicsConfig = field(default_factory=KinematicsConfig)
    occupancy_grid: OccupancyGridConfig = field(default_factory=OccupancyGridConfig)
    lidar_observation: LidarObservationConfig = field(default_factory=LidarObservationConfig)
    messages: MessagesConfig = field(default_factory=MessagesConfig)
    way: WayConfig = field(default_factory=WayConfig)
    conflicts: ConflictsConfig = field(default_factory=ConflictsConfig)
    history: HistoryConfig = field(default_factory=HistoryConfig)
    registered: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.registered:
            there = name in REGISTERED_SENSORS
            check(there, "sensors.registered", name, REGISTERED_SENSORS.advice())
        once = len(set(self.registered)) == len(self.registered)
        self.need("registered", once, "must name each sensor once")
        is_any_on = bool(self.registered) or any(one.is_on for one in self._sections().values())
        check(is_any_on, "sensors", "all off", "an agent must observe something; switch one on")

    def _sections(self) -> dict[str, SensorSection]:
        """Return the keys of each sensor of the package, by its name."""
        named = ((entry.name, getattr(self, entry.name)) for entry in fields(self))
        return {name: value for name, value in named if isinstance(value, SensorSection)}

    def without_sight(self) -> SensorsConfig:
        """Return the same sensors, but for those that look at others or at signals."""
        blind: dict[str, Any] = {
            name: section.without_sight() for name, section in self._sections().items()
        }
        return replace(self, registered=(), **blind)


def _is_range(bounds: tuple[float, ...]) -> bool:
    return len(bounds) == 2 and all(math.isfinite(b) for b in bounds) and bounds[0] < bounds[1]


def _check_features(key: str, features: tuple[str, ...], known: tuple[str, ...]) -> None:
    for name in features:
        check(name in known, key, name, f"no such feature; there are {', '.join(known)}")
    check(len(set(features)) == len(features), key, features, "must name each feature once")


def _check_ranges(key: str, ranges: dict[str, tuple[float, ...]]) -> None:
    for name, bounds in ranges.items():
        check(
            name in VEHICLE_FEATURES,
            key,
            name,
            f"no such feature; there are {', '.join(VEHICLE_FEATURES)}",
        )
        check(_is_range(bounds), f"{key}.{name}", bounds, "must be [min, max], rising and finite")
