"""The keys under `sensors` of `env.yaml`: the configuration of each sensor of an agent.

Counts of 0 and empty lists switch a sensor off. `kinematics`, `occupancy_grid` and
`lidar_observation` have the names, the defaults and the meanings of highway-env's observations
(Leurent: "An environment for autonomous driving decision-making", 2018), so that policies for
highway-env can be used.
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
# A layer of an occupancy grid is one of these features, or a mask of the road.
GRID_FEATURES = (*VEHICLE_FEATURES, "on_road")

# Larger grids are a mistake: 100 agents would observe 26 MB per step.
MAX_GRID_NUMBERS = 65_536


@dataclass(frozen=True)
class SensorSection(Section, key=""):
    """The keys of one sensor.

    A subclass names its `switches`: the sensor is off if all of these fields are 0, empty or false.
    The `sight` switches turn on the perception of other vehicles or signals.
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

    def plain(self) -> Self:
        """Return the section; if the sensor is off, its other keys are set to their defaults.

        The keys of a sensor that is off have no effect.
        """
        return self if self.is_on else type(self)(**self._cleared(self.switches))

    def without_sight(self) -> Self:
        """Return the same sensor with its perception of vehicles and signals switched off."""
        return replace(self, **self._cleared(self.sight))

    def _cleared(self, names: tuple[str, ...]) -> dict[str, Any]:
        """Return 0, false or an empty value for each of these fields."""
        return {name: type(getattr(self, name))() for name in names}


@dataclass(frozen=True)
class EgoConfig(SensorSection, key="sensors.ego", switches=("enabled",)):
    """The agent's vehicle, its lane, and the next lane change of its plan.

    Attributes:
        enabled: false switches the sensor off.
        size: adds the limits of the vehicle type: size, wheelbase, steering, acceleration, braking,
            speed.
    """

    enabled: bool = True
    size: bool = False


@dataclass(frozen=True)
class RouteAheadConfig(SensorSection, key="sensors.route", switches=("points",)):
    """Points of the route ahead, in the ego frame.

    Attributes:
        points: number of points; 0 switches the sensor off.
        spacing_m: distance along the route between two points.
    """

    points: Annotated[int, Whole(0, 64)] = 8
    spacing_m: Annotated[float, Within(0.5, 100.0)] = 6.0


@dataclass(frozen=True)
class NeighborsConfig(
    SensorSection, key="sensors.neighbors", switches=("count",), sight=("count",)
):
    """The nearest vehicles, in the ego frame.

    Attributes:
        count: maximum number of vehicles; 0 switches the sensor off.
        range_m: distance up to which vehicles are seen.
        through_walls: false hides vehicles whose centre is behind a wall of `map.buildings`.
    """

    count: Annotated[int, Whole(0, 64)] = 8
    range_m: Annotated[float, Within(1.0, 300.0)] = 60.0
    through_walls: bool = True


@dataclass(frozen=True)
class SignalAheadConfig(
    SensorSection, key="sensors.signal", switches=("enabled",), sight=("enabled",)
):
    """The next signal or yield line on the route.

    Attributes:
        enabled: false switches the sensor off.
        range_m: distance ahead up to which it is seen.
        timing: adds the exact time until the signal changes, from the world's state. A real vehicle
            knows it only from messages (`sensors.messages.timing`).
        stop_signs: how a stop sign is shown. `give_way`: like a yield line; `own`: with an
            additional number for stop signs.
    """

    enabled: bool = True
    range_m: Annotated[float, Within(1.0, 300.0)] = 80.0
    timing: bool = False
    stop_signs: Literal["give_way", "own"] = "give_way"


@dataclass(frozen=True)
class LanesConfig(SensorSection, key="sensors.lanes", switches=("range_m",), sight=("range_m",)):
    """Vehicles by position along the surrounding lanes, and the next vehicle to cross the path.

    Attributes:
        range_m: distance along lanes up to which vehicles are seen; 0 switches the sensor off.
    """

    range_m: Annotated[float, Within(0.0, 300.0)] = 0.0


@dataclass(frozen=True)
class LidarConfig(SensorSection, key="sensors.lidar", switches=("rays",), sight=("rays",)):
    """Distances around the vehicle.

    Attributes:
        rays: number of equally spaced rays; 0 switches the sensor off.
        range_m: range of a ray.
        speeds: adds the relative speed of the object that each ray hits.
    """

    rays: Annotated[int, Whole(0, 1024)] = 64
    range_m: Annotated[float, Within(1.0, 300.0)] = 60.0
    speeds: bool = False


@dataclass(frozen=True)
class KinematicsConfig(
    SensorSection, key="sensors.kinematics", switches=("vehicles_count",), sight=("vehicles_count",)
):
    """highway-env's `Kinematics`: a table with a row per vehicle, starting with the ego vehicle.

    Attributes:
        vehicles_count: number of rows, including the ego vehicle (highway-env: 5); 0 switches the
            sensor off.
        features: columns, from `presence`, `x`, `y`, `vx`, `vy`, `heading`, `cos_h`, `sin_h`,
            `cos_d`, `sin_d`, `long_off`, `lat_off`, `ang_off`; see `sensors.observed.highway`.
        features_range: feature to [min, max], mapped to [-1, 1]; other features stay unmapped.
            Empty: x ±200 m, y ±4 m for each lane of the map's widest road, vx and vy ±80 m/s.
        absolute: whether x, y, vx and vy of other vehicles are in the world's frame; otherwise
            relative to the ego vehicle. The ego row is always in the world's frame.
        order: `sorted`: nearest along the lane first. `shuffled`: the vehicles with the smallest
            ids, in random order.
        normalize: whether ranges are mapped to [-1, 1].
        clip: whether mapped values are clipped to [-1, 1].
        see_behind: whether vehicles more than two lengths behind are included.
        observe_intentions: whether `cos_d` and `sin_d` of other vehicles are filled in; otherwise
            they are 0.
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
        self.need("features", bool(self.features), "must name at least one feature")
        _check_features(f"{key}.features", self.features, VEHICLE_FEATURES)
        _check_ranges(f"{key}.features_range", self.features_range)


@dataclass(frozen=True)
class OccupancyGridConfig(
    SensorSection, key="sensors.occupancy_grid", switches=("features",), sight=("features",)
):
    """highway-env's `OccupancyGrid`: layers of cells around the vehicle.

    Attributes:
        features: layers, from `kinematics.features` and `on_road` (highway-env: presence, vx, vy,
            on_road); an empty list switches the sensor off.
        features_range: feature to [min, max], mapped to [-1, 1]. Empty: vx and vy ±80 m/s.
        grid_size_m: [[min x, max x], [min y, max y]] around the vehicle.
        grid_step_m: [x, y], sides of a cell.
        align_to_vehicle_axes: whether the grid rotates with the vehicle.
        clip: whether all values are clipped to [-1, 1].
        as_image: whether values are mapped from [-1, 1] to whole numbers from 0 to 255.
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
            "must be [[min x, max x], [min y, max y]], both increasing",
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
        """Number of cells along x and along y."""
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
        cells: number of sectors (highway-env: 16); 0 switches the sensor off.
        maximum_range_m: range of the sensor.
        normalize: whether distances and speeds are divided by `maximum_range_m`.
    """

    cells: Annotated[int, Whole(0, 1024)] = 0
    maximum_range_m: Annotated[float, Within(1.0, 300.0)] = 60.0
    normalize: bool = True


@dataclass(frozen=True)
class MessagesConfig(
    SensorSection, key="sensors.messages", switches=("objects", "events", "signal")
):
    """Information received in messages; see `v2x`.

    Attributes:
        objects: number of nearest vehicles known from messages; 0: none.
        events: number of nearest events known from messages; 0: none.
        signal: adds the message of the roadside unit at the next signal on the route.
        timing: adds to that message the distance to the stop line and the times of signal changes.
        range_m: distance that is scaled to 1; greater distances are clipped to 1.
    """

    objects: Annotated[int, Whole(0, 64)] = 0
    events: Annotated[int, Whole(0, 64)] = 0
    signal: bool = False
    timing: bool = False
    range_m: Annotated[float, Within(1.0, 10_000.0)] = 100.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need("timing", self.signal or not self.timing, "needs sensors.messages.signal = true")


@dataclass(frozen=True)
class WayConfig(
    SensorSection, key="sensors.way", switches=("distances_m", "lines"), sight=("lines",)
):
    """The path ahead: its shape, its lanes and its stop lines.

    Attributes:
        distances_m: increasing distances at which the path is sampled; an empty list: none.
        lines: number of next stop lines with a signal or a yield rule; 0: none.
        range_m: distance ahead up to which a line is seen.
        timing: adds the exact time until a line's signal changes, from the world's state. A real
            vehicle knows it only from messages (`sensors.messages.timing`).
        stop_signs: how a stop sign is shown. `give_way`: like a yield line; `own`: with an
            additional number for stop signs; `red`: like a red light, as `tollgate_ippo` needs it.
    """

    distances_m: tuple[float, ...] = ()
    lines: Annotated[int, Whole(0, 8)] = 0
    range_m: Annotated[float, Within(1.0, 300.0)] = 100.0
    timing: bool = False
    stop_signs: Literal["give_way", "own", "red"] = "give_way"

    def __post_init__(self) -> None:
        super().__post_init__()
        distances = self.distances_m
        self.need(
            "distances_m",
            len(distances) <= 64
            and all(0.5 <= distance <= 300.0 for distance in distances)
            and all(a < b for a, b in pairwise(distances)),
            "must be at most 64 increasing distances from 0.5 to 300",
        )


@dataclass(frozen=True)
class ConflictsConfig(
    SensorSection, key="sensors.conflicts", switches=("count",), sight=("count",)
):
    """The vehicles that come closest to the ego path, sorted by time and distance.

    Their plans are unknown except for `indicators`: speed and heading are assumed to be constant.

    Attributes:
        count: maximum number of vehicles; 0 switches the sensor off.
        range_m: distance up to which vehicles are seen.
        through_walls: false hides vehicles whose centre is behind a wall of `map.buildings`.
        heard: true adds vehicles known only from messages (`v2x`), at extrapolated positions. It
            also adds two features per vehicle: whether it is seen, and the age of the message.
        indicators: true assumes that seen vehicles follow their lanes and the direction that they
            indicate at their present or next junction. It also adds this turn as a feature.
        indicators_m: vehicles indicate within this distance of the junction; farther away, their
            turn is unknown. 0: they indicate at any distance, as read from the world's state.
        horizon_s: time for which motion is predicted; a multiple of 0.5 s.
        departs: false assumes that the ego vehicle keeps its speed, but drives at least 3 m/s. True
            assumes that it accelerates with 2 m/s² to the speed limit of its lane.
    """

    count: Annotated[int, Whole(0, 64)] = 0
    range_m: Annotated[float, Within(1.0, 300.0)] = 60.0
    through_walls: bool = True
    heard: bool = False
    indicators: bool = False
    indicators_m: Annotated[float, Within(0.0, 300.0)] = 0.0
    horizon_s: Annotated[float, Within(0.5, 15.0)] = 4.5
    departs: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        halves = 2.0 * self.horizon_s
        self.need("horizon_s", halves == round(halves), "must be a multiple of 0.5")


@dataclass(frozen=True)
class HistoryConfig(SensorSection, key="sensors.history", switches=("steps",)):
    """The last controls and speeds of the vehicle.

    Attributes:
        steps: number of steps; 0 switches the sensor off.
    """

    steps: Annotated[int, Whole(0, 64)] = 0


@dataclass(frozen=True)
class SensorsConfig(Section, key="sensors"):
    """The sensors of every agent; a count or range of 0 switches a sensor off.

    Attributes:
        stack: number of latest observations that are stacked, oldest first. After a reset, all are
            copies of the first observation.
        registered: names of the registered sensors from outside the package that are on
            (docs/guides/extending.md); their features come last.
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
            if name not in REGISTERED_SENSORS:
                check(False, "sensors.registered", name, REGISTERED_SENSORS.advice())
        once = len(set(self.registered)) == len(self.registered)
        self.need("registered", once, "must name each sensor once")
        is_any_on = bool(self.registered) or any(one.is_on for one in self.sections().values())
        check(is_any_on, "sensors", "all off", "an agent must observe something; switch one on")

    def sections(self) -> dict[str, SensorSection]:
        """Return the configuration of each sensor of the package, by name."""
        named = ((entry.name, getattr(self, entry.name)) for entry in fields(self))
        return {name: value for name, value in named if isinstance(value, SensorSection)}

    def without_sight(self) -> SensorsConfig:
        """Return the same sensors, except sensors that see other vehicles or signals."""
        blind: dict[str, Any] = {
            name: section.without_sight() for name, section in self.sections().items()
        }
        return replace(self, registered=(), **blind)

    def plain(self) -> SensorsConfig:
        """Return the same sensors, with the defaults of all keys that have no effect."""
        plain: dict[str, Any] = {name: section.plain() for name, section in self.sections().items()}
        return replace(self, **plain)


def _is_range(bounds: tuple[float, ...]) -> bool:
    return len(bounds) == 2 and all(math.isfinite(b) for b in bounds) and bounds[0] < bounds[1]


def _check_features(key: str, features: tuple[str, ...], known: tuple[str, ...]) -> None:
    for name in features:
        check(name in known, key, name, f"no such feature; must be one of {', '.join(known)}")
    check(len(set(features)) == len(features), key, features, "must name each feature once")


def _check_ranges(key: str, ranges: dict[str, tuple[float, ...]]) -> None:
    for name, bounds in ranges.items():
        check(
            name in VEHICLE_FEATURES,
            key,
            name,
            f"no such feature; must be one of {', '.join(VEHICLE_FEATURES)}",
        )
        check(_is_range(bounds), f"{key}.{name}", bounds, "must be finite and increasing")
