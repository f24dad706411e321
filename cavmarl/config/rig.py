"""The keys under `rig` of `env.yaml`: sensors that are mounted on every agent's vehicle.

    rig:
      roof: {type: lidar, rate_hz: 10, z_m: 1.6, rays: 360, range_m: 60}
      gnss: {type: gnss, rate_hz: 5, phase_ticks: 2, noise: [1.0]}

Each class is one type of sensor; its name in `type` tells which. Frames are right-handed: x
forward, y to the left, z up. The vehicle's has its origin on the ground below the centre of the
body.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Annotated, Any, ClassVar, Literal

from cavmarl.config.checks import Whole, Within, check, check_finite, check_ranges

MAX_SENSORS = 64
MAX_RAYS = 8192  # of a layer: one every 0.05 degrees all around, and less than that
MAX_SAMPLE_NUMBERS = 1 << 22  # of one sensor: a picture of 1920 by 1080 with two bytes
MAX_RATE_HZ = 10_000.0
MAX_REACH_M = 300.0

_LARGEST_CYCLE = 10_000  # ticks after which an accumulated schedule repeats itself
_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")


class ByType:
    """Tells the classes of a union apart by their `type`, for validation by pydantic."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic import Field  # slow to import

        return handler(Annotated[source, Field(discriminator="type")])


@dataclass(frozen=True, kw_only=True)
class MountedConfig:
    """What all sensors of a rig have.

    Attributes:
        x_m: place in the vehicle's frame.
        y_m: place, positive to the left.
        z_m: place, above the ground.
        yaw_deg: direction, counter-clockwise from forward; turned first.
        pitch_deg: then up, positive as uphill.
        roll_deg: then about its own x axis, positive with the left side up.
        dropout: chance that a sample is lost.
    """

    x_m: Annotated[float, Within(-100.0, 100.0)] = 0.0
    y_m: Annotated[float, Within(-100.0, 100.0)] = 0.0
    z_m: Annotated[float, Within(-100.0, 100.0)] = 0.0
    yaw_deg: Annotated[float, Within(-360.0, 360.0)] = 0.0
    pitch_deg: Annotated[float, Within(-360.0, 360.0)] = 0.0
    roll_deg: Annotated[float, Within(-360.0, 360.0)] = 0.0
    dropout: Annotated[float, Within(0.0, 1.0)] = 0.0

    units: ClassVar[tuple[str, ...]]  # of the channels, which noise and bias are counted by
    in_batches: ClassVar[bool] = False  # it can tell what has been between two ticks

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one sample; by default one number a channel."""
        return (len(self.units),)

    def check(self, key: str) -> None:
        """Refuse values that cannot work.

        Args:
            key: where they stand, as `rig.NAME`.

        Raises:
            ConfigError: which one, and what can work.
        """
        check_ranges(key, self)


@dataclass(frozen=True, kw_only=True)
class SampledConfig(MountedConfig):
    """A sensor with a rate.

    Attributes:
        rate_hz: samples a second.
        phase_ticks: tick of the first sample; 0: at the reset.
        schedule: `exact`: one sample every so many ticks, or so many every tick; other rates are
            refused. `accumulate`: a rate below that of ticks is met on average, by the first tick
            at or after each sample's time.
        noise: standard deviation of each channel, or one of all; in the channel's unit.
        bias: standard deviation of a constant error that is drawn for each vehicle and episode.
    """

    rate_hz: Annotated[float, Within(0.001, MAX_RATE_HZ)]
    phase_ticks: int = 0
    schedule: Literal["exact", "accumulate"] = "exact"
    noise: tuple[float, ...] = (0.0,)
    bias: tuple[float, ...] = (0.0,)

    def check(self, key: str) -> None:
        """As `MountedConfig.check`."""
        super().check(key)
        for name in ("noise", "bias"):
            values = getattr(self, name)
            channels = len(self.units)
            check(
                len(values) in (1, channels),
                f"{key}.{name}",
                values,
                f"must be one number or {channels}, of {', '.join(self.units)}",
            )
            for value in values:
                check_finite(f"{key}.{name}", value, 0.0, 1e6)

    def check_schedule(self, key: str, sim_dt_s: float) -> None:
        """Refuse a rate that does not fit the ticks.

        Raises:
            ConfigError: with the nearest rates that fit.
        """
        rate = cadence(self.rate_hz, sim_dt_s)
        accumulates = self.schedule == "accumulate" and rate < 1
        fits = rate.numerator == 1 or rate.denominator == 1 or accumulates
        check(fits, f"{key}.rate_hz", self.rate_hz, _other_rates(rate, sim_dt_s, self.in_batches))
        check(
            rate <= 1 or self.in_batches,
            f"{key}.rate_hz",
            self.rate_hz,
            f"it senses once a tick at most, {1.0 / sim_dt_s:g} Hz with clock.sim_dt_s = "
            f"{sim_dt_s:g}",
        )
        last = max(0, math.ceil(1 / rate) - 1)
        check(
            0 <= self.phase_ticks <= last,
            f"{key}.phase_ticks",
            self.phase_ticks,
            f"must be from 0 to {last}, less than the ticks from one sample to the next",
        )


def cadence(rate_hz: float, sim_dt_s: float) -> Fraction:
    """Samples a tick as the fraction that is meant: 100 Hz with 0.05 s are 5, 3 Hz are 3/20."""
    return Fraction(rate_hz * sim_dt_s).limit_denominator(_LARGEST_CYCLE)


def samples_per_step(config: MountedConfig, sim_dt_s: float, ticks_per_step: int) -> int:
    """The most samples that a sensor can have in one step."""
    if isinstance(config, SampledConfig):
        return math.ceil(ticks_per_step * cadence(config.rate_hz, sim_dt_s))
    return ticks_per_step


def _other_rates(rate: Fraction, sim_dt_s: float, in_batches: bool) -> str:
    if rate < 1:
        ticks = math.floor(1 / rate)
        near = [1.0 / (n * sim_dt_s) for n in (ticks + 1, ticks)]
        way_out = "; or schedule: accumulate, which meets it on average"
    else:
        near = (
            [n / sim_dt_s for n in (math.floor(rate), math.ceil(rate))]
            if in_batches
            else [1.0 / sim_dt_s]
        )
        way_out = ""
    rates = " or ".join(f"{hz:.6g}" for hz in near)
    return f"does not fit ticks of clock.sim_dt_s = {sim_dt_s:g}; try {rates}{way_out}"


def _check_exact(key: str, config: SampledConfig) -> None:
    """Refuse errors of classes, which are names and no quantities."""
    for name in ("noise", "bias"):
        values = getattr(config, name)
        check(not any(values), f"{key}.{name}", values, "must be 0: a class has no errors")


@dataclass(frozen=True, kw_only=True)
class LidarRigConfig(SampledConfig):
    """Distances along rays, in m; `range_m` where nothing is.

    Attributes:
        range_m: how far it sees.
        rays: of one layer, from the right to the left.
        layers: 1: a plane lidar.
        fov_deg: across all rays; 360: all around, beginning forward.
        lower_deg: elevation of the lowest of several layers.
        upper_deg: of the highest one.
    """

    type: Literal["lidar"] = "lidar"
    range_m: Annotated[float, Within(1.0, MAX_REACH_M)] = 60.0
    rays: Annotated[int, Whole(1, MAX_RAYS)] = 180
    layers: Annotated[int, Whole(1, 128)] = 1
    fov_deg: Annotated[float, Within(1.0, 360.0)] = 360.0
    lower_deg: Annotated[float, Within(-89.0, 89.0)] = -15.0
    upper_deg: float = 5.0
    units: ClassVar[tuple[str, ...]] = ("m",)

    @property
    def shape(self) -> tuple[int, ...]:
        """(layers, rays)."""
        return (self.layers, self.rays)

    def check(self, key: str) -> None:
        """As `MountedConfig.check`."""
        super().check(key)
        check_finite(f"{key}.upper_deg", self.upper_deg, self.lower_deg, 89.0)


@dataclass(frozen=True, kw_only=True)
class RadarConfig(SampledConfig):
    """The nearest targets: range in m, azimuth in rad, radial speed in m/s (positive: away).

    Attributes:
        range_m: how far it sees.
        fov_deg: opening in the plane.
        targets: most that are listed; the rest of the list is zeros.
        rays: directions that are tried.
    """

    type: Literal["radar"] = "radar"
    range_m: Annotated[float, Within(1.0, MAX_REACH_M)] = 100.0
    fov_deg: Annotated[float, Within(1.0, 360.0)] = 60.0
    targets: Annotated[int, Whole(1, 256)] = 16
    rays: Annotated[int, Whole(1, MAX_RAYS)] = 120
    units: ClassVar[tuple[str, ...]] = ("m", "rad", "m/s")

    @property
    def shape(self) -> tuple[int, ...]:
        """(targets, 3)."""
        return (self.targets, 3)


@dataclass(frozen=True, kw_only=True)
class CameraConfig(SampledConfig):
    """A pinhole camera.

    Attributes:
        width: pixels, from left to right.
        height: pixels, from top to bottom.
        fov_deg: horizontal opening.
        range_m: how far it sees.
    """

    width: Annotated[int, Whole(1, 4096)] = 160
    height: Annotated[int, Whole(1, 4096)] = 90
    fov_deg: Annotated[float, Within(1.0, 170.0)] = 90.0
    range_m: Annotated[float, Within(1.0, MAX_REACH_M)] = 100.0

    @property
    def shape(self) -> tuple[int, ...]:
        """(height, width)."""
        return (self.height, self.width)


@dataclass(frozen=True, kw_only=True)
class DepthCameraConfig(CameraConfig):
    """Depth along the axis in m; `range_m` where nothing is."""

    type: Literal["depth_camera"] = "depth_camera"
    units: ClassVar[tuple[str, ...]] = ("m",)


@dataclass(frozen=True, kw_only=True)
class SemanticCameraConfig(CameraConfig):
    """The class of what each pixel shows."""

    type: Literal["semantic_camera"] = "semantic_camera"
    units: ClassVar[tuple[str, ...]] = ("class",)

    def check(self, key: str) -> None:
        """As `MountedConfig.check`."""
        super().check(key)
        _check_exact(key, self)


@dataclass(frozen=True, kw_only=True)
class RgbCameraConfig(CameraConfig):
    """A shaded picture, red, green and blue from 0 to 255."""

    type: Literal["rgb_camera"] = "rgb_camera"
    units: ClassVar[tuple[str, ...]] = ("red", "green", "blue")

    @property
    def shape(self) -> tuple[int, ...]:
        """(height, width, 3)."""
        return (self.height, self.width, 3)


@dataclass(frozen=True, kw_only=True)
class BevGridConfig(SampledConfig):
    """What lies around the vehicle, seen from above: the class of each cell.

    Attributes:
        ahead_m: how far the grid reaches before the sensor.
        behind_m: and behind.
        aside_m: to either side.
        cell_m: side of a cell.
    """

    type: Literal["bev_grid"] = "bev_grid"
    ahead_m: Annotated[float, Within(0.0, MAX_REACH_M)] = 32.0
    behind_m: Annotated[float, Within(0.0, MAX_REACH_M)] = 16.0
    aside_m: Annotated[float, Within(0.0, MAX_REACH_M)] = 16.0
    cell_m: Annotated[float, Within(0.05, 50.0)] = 0.5
    units: ClassVar[tuple[str, ...]] = ("class",)

    @property
    def shape(self) -> tuple[int, ...]:
        """(cells along, cells across), the first row farthest ahead, the first column left."""
        along = math.floor((self.ahead_m + self.behind_m) / self.cell_m + 1e-9)
        return (along, math.floor(2.0 * self.aside_m / self.cell_m + 1e-9))

    def check(self, key: str) -> None:
        """As `MountedConfig.check`."""
        super().check(key)
        _check_exact(key, self)
        for name in ("pitch_deg", "roll_deg"):
            value = getattr(self, name)
            check(value == 0.0, f"{key}.{name}", value, "must be 0: it looks straight down")
        check(
            min(self.shape) >= 1,
            f"{key}.cell_m",
            self.cell_m,
            "must fit at least once into ahead_m + behind_m and into twice aside_m",
        )


@dataclass(frozen=True, kw_only=True)
class GnssConfig(SampledConfig):
    """Latitude and longitude in degrees, and height in m (WGS 84); noise in m: east, north, up.

    Attributes:
        origin_lat_deg: where the map's (0, 0) is taken to be, if the map does not say.
        origin_lon_deg: see `origin_lat_deg`.
        origin_height_m: the height above the ellipsoid of z = 0.
    """

    type: Literal["gnss"] = "gnss"
    origin_lat_deg: Annotated[float, Within(-89.0, 89.0)] = 48.0
    origin_lon_deg: Annotated[float, Within(-180.0, 180.0)] = 11.0
    origin_height_m: Annotated[float, Within(-500.0, 10_000.0)] = 0.0
    units: ClassVar[tuple[str, ...]] = ("m east", "m north", "m up")


@dataclass(frozen=True, kw_only=True)
class ImuConfig(SampledConfig):
    """Specific force in m/s² and angular rate in rad/s, along the sensor's x, y and z."""

    type: Literal["imu"] = "imu"
    units: ClassVar[tuple[str, ...]] = ("m/s²", "m/s²", "m/s²", "rad/s", "rad/s", "rad/s")
    in_batches: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class OdometryConfig(SampledConfig):
    """Speed in m/s, yaw rate in rad/s, and the distance that the wheels have rolled, in m."""

    type: Literal["odometry"] = "odometry"
    units: ClassVar[tuple[str, ...]] = ("m/s", "rad/s", "m")
    in_batches: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class LaneBoundaryConfig(SampledConfig):
    """The lane that the sensor is on.

    To its left and its right boundary, and its width, in m; the sensor's direction from the lane's
    in rad; and the curvature of the way in 1/m, positive to the left.

    Attributes:
        lookahead_m: length of the way that the curvature is measured over.
    """

    type: Literal["lane_boundary"] = "lane_boundary"
    lookahead_m: Annotated[float, Within(1.0, 100.0)] = 10.0
    units: ClassVar[tuple[str, ...]] = ("m", "m", "m", "rad", "1/m")


@dataclass(frozen=True, kw_only=True)
class CollisionConfig(MountedConfig):
    """What happens to the vehicle, and when: EVENT_* bits, and the vehicle hit (-1: none)."""

    type: Literal["collision"] = "collision"
    units: ClassVar[tuple[str, ...]] = ("bits", "id")


RigSensor = (
    LidarRigConfig
    | RadarConfig
    | DepthCameraConfig
    | SemanticCameraConfig
    | RgbCameraConfig
    | BevGridConfig
    | GnssConfig
    | ImuConfig
    | OdometryConfig
    | LaneBoundaryConfig
    | CollisionConfig
)

Rig = dict[str, Annotated[RigSensor, ByType()]]


def check_rig(rig: Mapping[str, MountedConfig], sim_dt_s: float, ticks_per_step: int) -> None:
    """Refuse a rig that cannot work."""
    check(len(rig) <= MAX_SENSORS, "rig", len(rig), f"must be {MAX_SENSORS} sensors at most")
    for name, sensor in rig.items():
        key = f"rig.{name}"
        check(
            _NAME.fullmatch(name) is not None,
            "rig",
            name,
            "the name of a sensor must be small letters, digits and _, a letter first",
        )
        sensor.check(key)
        if isinstance(sensor, SampledConfig):
            sensor.check_schedule(key, sim_dt_s)
        numbers = math.prod(sensor.shape) * samples_per_step(sensor, sim_dt_s, ticks_per_step)
        check(
            numbers <= MAX_SAMPLE_NUMBERS,
            key,
            sensor.shape,
            f"a step of it is {numbers} numbers, more than {MAX_SAMPLE_NUMBERS}; use fewer pixels, "
            "rays or cells, or a smaller rate_hz",
        )
