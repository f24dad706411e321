"""The keys under `rig` of `env.yaml`: sensors that are mounted on every agent's vehicle.

    rig:
      roof: {type: lidar, rate_hz: 10, z_m: 1.6, rays: 360, range_m: 60}
      gnss: {type: gnss, rate_hz: 5, phase_ticks: 2, noise: [1.0]}

Each class is one type of sensor, selected by `type`. Frames are right-handed: x forward, y to the
left, z up. The origin of the vehicle's frame is on the ground, below the centre of the body.
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
MAX_RAYS = 8192  # per layer; finer than 0.05° for a full circle
MAX_SAMPLE_NUMBERS = 1 << 22  # per sensor and step: two depth images of 1920 by 1080 pixels
MAX_RATE_HZ = 10_000.0
MAX_REACH_M = 300.0

_LARGEST_CYCLE = 10_000  # ticks after which an accumulated schedule repeats itself
_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")


class ByType:
    """Selects the class of a union by its `type`, for validation by pydantic."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic import Field  # slow to import

        return handler(Annotated[source, Field(discriminator="type")])


@dataclass(frozen=True, kw_only=True)
class MountedConfig:
    """The keys of all sensors of a rig.

    Attributes:
        x_m: position in the vehicle's frame, forward.
        y_m: position, to the left.
        z_m: position, above the ground.
        yaw_deg: direction, counter-clockwise from forward; rotated first.
        pitch_deg: rotated second, positive upwards.
        roll_deg: rotated last, about the sensor's x axis; positive: left side up.
        dropout: probability that a sample is lost.
    """

    x_m: Annotated[float, Within(-100.0, 100.0)] = 0.0
    y_m: Annotated[float, Within(-100.0, 100.0)] = 0.0
    z_m: Annotated[float, Within(-100.0, 100.0)] = 0.0
    yaw_deg: Annotated[float, Within(-360.0, 360.0)] = 0.0
    pitch_deg: Annotated[float, Within(-360.0, 360.0)] = 0.0
    roll_deg: Annotated[float, Within(-360.0, 360.0)] = 0.0
    dropout: Annotated[float, Within(0.0, 1.0)] = 0.0

    units: ClassVar[tuple[str, ...]]  # units of the channels, also of noise and bias
    in_batches: ClassVar[bool] = False  # can report several samples per tick

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a sample; by default one number per channel."""
        return (len(self.units),)

    def check(self, key: str) -> None:
        """Check all values.

        Args:
            key: place of the sensor, `rig.NAME`.

        Raises:
            ConfigError: a value is not allowed; the message says which values are.
        """
        check_ranges(key, self)


@dataclass(frozen=True, kw_only=True)
class SampledConfig(MountedConfig):
    """A sensor with a sampling rate.

    Attributes:
        rate_hz: samples per second.
        phase_ticks: tick of the first sample; 0: at the reset.
        schedule: `exact`: one sample every n ticks, or n samples every tick; other rates are
            errors. `accumulate`: a rate below the tick rate is kept on average. A sample is taken
            at the first tick at or after its time.
        noise: standard deviation per channel, or one for all channels; in the channel's unit.
        bias: standard deviation of a constant error, drawn for each vehicle and episode.
    """

    rate_hz: Annotated[float, Within(0.001, MAX_RATE_HZ)]
    phase_ticks: int = 0
    schedule: Literal["exact", "accumulate"] = "exact"
    noise: tuple[float, ...] = (0.0,)
    bias: tuple[float, ...] = (0.0,)

    def check(self, key: str) -> None:
        """Check all values, as `MountedConfig.check`."""
        super().check(key)
        for name in ("noise", "bias"):
            values = getattr(self, name)
            channels = len(self.units)
            check(
                len(values) in (1, channels),
                f"{key}.{name}",
                values,
                f"must be one number, or {channels}: {', '.join(self.units)}",
            )
            for value in values:
                check_finite(f"{key}.{name}", value, 0.0, 1e6)

    def check_schedule(self, key: str, sim_dt_s: float) -> None:
        """Check that the rate and the phase fit the ticks.

        Raises:
            ConfigError: they do not fit; the message gives the nearest rates that do.
        """
        rate = cadence(self.rate_hz, sim_dt_s)
        accumulates = self.schedule == "accumulate" and rate < 1
        fits = rate.numerator == 1 or rate.denominator == 1 or accumulates
        check(fits, f"{key}.rate_hz", self.rate_hz, _other_rates(rate, sim_dt_s, self.in_batches))
        check(
            rate <= 1 or self.in_batches,
            f"{key}.rate_hz",
            self.rate_hz,
            f"must be at most one sample per tick, {1.0 / sim_dt_s:g} Hz with clock.sim_dt_s = "
            f"{sim_dt_s:g}",
        )
        last = max(0, math.ceil(1 / rate) - 1)
        check(
            0 <= self.phase_ticks <= last,
            f"{key}.phase_ticks",
            self.phase_ticks,
            f"must be from 0 to {last}, less than the ticks between two samples",
        )


def cadence(rate_hz: float, sim_dt_s: float) -> Fraction:
    """Return samples per tick as a fraction: with 0.05 s, 100 Hz is 5 and 3 Hz is 3/20."""
    return Fraction(rate_hz * sim_dt_s).limit_denominator(_LARGEST_CYCLE)


def samples_per_step(config: MountedConfig, sim_dt_s: float, ticks_per_step: int) -> int:
    """Return the largest number of samples that a sensor can have in one step."""
    if isinstance(config, SampledConfig):
        return math.ceil(ticks_per_step * cadence(config.rate_hz, sim_dt_s))
    return ticks_per_step


def _other_rates(rate: Fraction, sim_dt_s: float, in_batches: bool) -> str:
    if rate < 1:
        ticks = math.floor(1 / rate)
        near = [1.0 / (n * sim_dt_s) for n in (ticks + 1, ticks)]
        way_out = "; or set schedule: accumulate, which keeps the rate on average"
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
    """Raise an error if a sensor that reports classes has noise or bias."""
    for name in ("noise", "bias"):
        values = getattr(config, name)
        check(not any(values), f"{key}.{name}", values, "must be 0: classes have no noise or bias")


@dataclass(frozen=True, kw_only=True)
class LidarRigConfig(SampledConfig):
    """Distances along rays in m; `range_m` if a ray hits nothing.

    Attributes:
        range_m: range of the sensor.
        rays: rays per layer, from right to left.
        layers: number of layers; 1: a planar lidar.
        fov_deg: angle that the rays cover; 360: a full circle whose first ray points forward.
        lower_deg: elevation of the lowest layer, if there are several.
        upper_deg: elevation of the highest layer.
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
        """Check all values, as `MountedConfig.check`."""
        super().check(key)
        check_finite(f"{key}.upper_deg", self.upper_deg, self.lower_deg, 89.0)


@dataclass(frozen=True, kw_only=True)
class RadarConfig(SampledConfig):
    """The nearest targets: range in m, azimuth in rad, radial speed in m/s (positive: away).

    Attributes:
        range_m: range of the sensor.
        fov_deg: horizontal field of view.
        targets: maximum number of targets; unused entries are zeros.
        rays: number of directions that are searched.
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
        width: pixels from left to right.
        height: pixels from top to bottom.
        fov_deg: horizontal field of view.
        range_m: range of the camera.
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
    """Depth along the optical axis in m; `range_m` where nothing is hit."""

    type: Literal["depth_camera"] = "depth_camera"
    units: ClassVar[tuple[str, ...]] = ("m",)


@dataclass(frozen=True, kw_only=True)
class SemanticCameraConfig(CameraConfig):
    """The semantic class of each pixel."""

    type: Literal["semantic_camera"] = "semantic_camera"
    units: ClassVar[tuple[str, ...]] = ("class",)

    def check(self, key: str) -> None:
        """Check all values, as `MountedConfig.check`."""
        super().check(key)
        _check_exact(key, self)


@dataclass(frozen=True, kw_only=True)
class RgbCameraConfig(CameraConfig):
    """A shaded colour image: red, green and blue from 0 to 255."""

    type: Literal["rgb_camera"] = "rgb_camera"
    units: ClassVar[tuple[str, ...]] = ("red", "green", "blue")

    @property
    def shape(self) -> tuple[int, ...]:
        """(height, width, 3)."""
        return (self.height, self.width, 3)


@dataclass(frozen=True, kw_only=True)
class BevGridConfig(SampledConfig):
    """A bird's-eye view: the semantic class of each cell around the vehicle.

    Attributes:
        ahead_m: extent of the grid in front of the sensor.
        behind_m: extent behind the sensor.
        aside_m: extent to either side.
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
        """(rows, columns); the first row is farthest ahead, the first column leftmost."""
        along = math.floor((self.ahead_m + self.behind_m) / self.cell_m + 1e-9)
        return (along, math.floor(2.0 * self.aside_m / self.cell_m + 1e-9))

    def check(self, key: str) -> None:
        """Check all values, as `MountedConfig.check`."""
        super().check(key)
        _check_exact(key, self)
        for name in ("pitch_deg", "roll_deg"):
            value = getattr(self, name)
            check(value == 0.0, f"{key}.{name}", value, "must be 0: the grid is horizontal")
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
        origin_lat_deg: latitude of the map's (0, 0), if the map has no georeference.
        origin_lon_deg: longitude of the map's (0, 0), see `origin_lat_deg`.
        origin_height_m: height of z = 0 above the ellipsoid.
    """

    type: Literal["gnss"] = "gnss"
    origin_lat_deg: Annotated[float, Within(-89.0, 89.0)] = 48.0
    origin_lon_deg: Annotated[float, Within(-180.0, 180.0)] = 11.0
    origin_height_m: Annotated[float, Within(-500.0, 10_000.0)] = 0.0
    units: ClassVar[tuple[str, ...]] = ("m east", "m north", "m up")


@dataclass(frozen=True, kw_only=True)
class ImuConfig(SampledConfig):
    """Specific force in m/s² and angular rate in rad/s, along the sensor's x, y and z axes."""

    type: Literal["imu"] = "imu"
    units: ClassVar[tuple[str, ...]] = ("m/s²", "m/s²", "m/s²", "rad/s", "rad/s", "rad/s")
    in_batches: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class OdometryConfig(SampledConfig):
    """Speed in m/s, yaw rate in rad/s, and the distance that the wheels have rolled in m."""

    type: Literal["odometry"] = "odometry"
    units: ClassVar[tuple[str, ...]] = ("m/s", "rad/s", "m")
    in_batches: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class LaneBoundaryConfig(SampledConfig):
    """The lane below the sensor.

    Distances to the left and right boundary and the width in m; the sensor's heading relative to
    the lane in rad; the curvature of the path in 1/m, positive to the left.

    Attributes:
        lookahead_m: length of the path over which the curvature is measured.
    """

    type: Literal["lane_boundary"] = "lane_boundary"
    lookahead_m: Annotated[float, Within(1.0, 100.0)] = 10.0
    units: ClassVar[tuple[str, ...]] = ("m", "m", "m", "rad", "1/m")


@dataclass(frozen=True, kw_only=True)
class CollisionConfig(MountedConfig):
    """Events per tick: EVENT_* bits, and the id of the vehicle that was hit (-1: none)."""

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
    """Check the number, the names and the values of a rig's sensors."""
    check(len(rig) <= MAX_SENSORS, "rig", len(rig), f"must have at most {MAX_SENSORS} sensors")
    for name, sensor in rig.items():
        key = f"rig.{name}"
        check(
            _NAME.fullmatch(name) is not None,
            "rig",
            name,
            "a sensor's name must be lower-case letters, digits and _, starting with a letter",
        )
        sensor.check(key)
        if isinstance(sensor, SampledConfig):
            sensor.check_schedule(key, sim_dt_s)
        numbers = math.prod(sensor.shape) * samples_per_step(sensor, sim_dt_s, ticks_per_step)
        check(
            numbers <= MAX_SAMPLE_NUMBERS,
            key,
            sensor.shape,
            f"has {numbers} numbers per step, more than {MAX_SAMPLE_NUMBERS}; use fewer pixels, "
            "rays or cells, or a smaller rate_hz",
        )
