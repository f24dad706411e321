"""Lidars, radars and cameras that clients attach, with CARLA's attributes and layouts."""

from __future__ import annotations

import math
import struct
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cavmarl.cosim.carla.carla_actors import TAG_OF_CLASS, CarlaActor
from cavmarl.cosim.carla.carla_geometry import axes_of
from cavmarl.cosim.carla.sensed_surroundings import Lens, RayHits, Surroundings
from cavmarl.cosim.carla.sensor_settings import SensorContext, SensorSettings
from cavmarl.sensors.kernels.camera_picture import FIRST_FACE
from cavmarl.sensors.kernels.panorama import (
    BUILDING,
    GROUND,
    LANE_LINE,
    NOTHING,
    NUM_SEMANTICS,
    ROAD,
)
from cavmarl.sensors.kernels.ray_caster import NO_HIT, WALL_HIT

CAMERA_RANGE_M = 300.0
_DEPTH_RANGE_M = 1000.0  # depth of pixels without an object
_DEPTH_STEPS = (1 << 24) - 1
_FACES_OF_PRISM = 6
_MAX_PIXELS = 4096  # on each side of a picture
_MAX_POINTS = 10_000_000
_ROAD_TAG, _BUILDING_TAG = 1, 3  # CARLA's semantic tags
_TAGS = {NOTHING: 11, GROUND: 10, ROAD: _ROAD_TAG, LANE_LINE: 24, BUILDING: _BUILDING_TAG}

TAGS = np.zeros(NUM_SEMANTICS, np.uint8)  # CARLA's tag of each class
for _semantic, _tag in (_TAGS | TAG_OF_CLASS).items():
    TAGS[_semantic] = _tag


class _Spin:
    """The rotation of a lidar, as CARLA's: clockwise, from -fov / 2 to fov / 2."""

    def __init__(self, settings: SensorSettings) -> None:
        self.channels = settings.whole("channels", 1, 512)
        self._points_per_s = settings.number("points_per_second", 1.0, _MAX_POINTS)
        self._turns_per_s = settings.number("rotation_frequency", 0.0, 1000.0)
        self._fov = math.radians(settings.number("horizontal_fov", 0.1, 360.0))
        upper = settings.number("upper_fov", -90.0, 90.0)
        lower = settings.number("lower_fov", -90.0, 90.0)
        self.elevations = np.radians(np.linspace(upper, lower, self.channels))
        self._angle = 0.0

    def next(self, elapsed_s: float) -> tuple[float, list[tuple[float, float, int]]]:
        """Return the angle at the start and the parts of a scan, in rad, clockwise.

        A part is the azimuth of its first column, the angle between columns, and their number.
        """
        started = self._angle
        columns = round(self._points_per_s * elapsed_s / self.channels)
        if columns < 1:
            return started, []
        sweep = min(self._turns_per_s * elapsed_s, 1.0) * self._fov or self._fov / columns
        step = sweep / columns
        self._angle = (started + self._turns_per_s * elapsed_s * self._fov) % self._fov
        first = started - 0.5 * self._fov
        before_edge = min(columns, math.ceil((self._fov - started) / step - 1e-9))
        if self._fov >= 2.0 * math.pi - 1e-9:
            before_edge = columns  # a full circle has no edge
        parts = [(first, step, before_edge)]
        if before_edge < columns:
            parts.append((first + before_edge * step - self._fov, step, columns - before_edge))
        return started, parts


class _Scan:
    """The hits of one sample, in order of channels, and clockwise within a channel."""

    def __init__(
        self,
        surroundings: Surroundings,
        actor: CarlaActor,
        carrier: int,
        spin: _Spin,
        elapsed_s: float,
        range_m: float,
    ) -> None:
        self.angle, parts = spin.next(elapsed_s)
        found = [
            self._cast(surroundings, actor, carrier, part, spin.elevations, range_m)
            for part in parts
        ]
        shape = (spin.channels, 0)
        self.distance = np.concatenate([one[0] for one in found] or [np.zeros(shape)], axis=1)
        self.what = np.concatenate([one[1] for one in found] or [np.zeros(shape)], axis=1)
        self.ids = np.concatenate([one[2] for one in found] or [np.zeros(shape)], axis=1)
        self.ways = np.concatenate([one[3] for one in found] or [np.zeros((*shape, 3))], axis=1)
        self.cosines = np.concatenate([one[4] for one in found] or [np.zeros(shape)], axis=1)
        self.tags = np.concatenate([one[5] for one in found] or [np.zeros(shape)], axis=1)

    @staticmethod
    def _cast(
        surroundings: Surroundings,
        actor: CarlaActor,
        carrier: int,
        part: tuple[float, float, int],
        elevations: NDArray[np.float64],
        range_m: float,
    ) -> tuple[NDArray[Any], ...]:
        first, step, columns = part
        last = -(first + (columns - 1) * step)  # the fan is counter-clockwise
        wrapped = math.remainder(last, 2.0 * math.pi)
        cast = surroundings.cast(actor.pose, carrier, (wrapped, step, columns), elevations, range_m)
        azimuths = (first + step * np.arange(columns))[None, :]
        level = np.cos(elevations)[:, None]
        ways = np.stack(
            [
                np.cos(azimuths) * level,
                np.sin(azimuths) * level,
                np.broadcast_to(np.sin(elevations)[:, None], (len(elevations), columns)),
            ],
            axis=2,
        )
        hits = cast.hits[::-1].T
        cosines, tags = _faces_hit(surroundings, cast)
        return (
            hits["distance"], hits["what"], hits["id"], ways, cosines[::-1].T, tags[::-1].T
        )  # fmt: skip


def _faces_hit(
    surroundings: Surroundings, cast: RayHits
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return the cosine of incidence and the tag (A, E) of each hit."""
    hits, rays = cast.hits, cast.rays
    what = hits["what"]
    cosines = np.abs(rays[..., 2])
    tags = np.full(what.shape, _ROAD_TAG, np.uint8)
    bodies = what >= 0
    if bodies.any():
        prisms = surroundings.panorama.prisms[what[bodies]]
        tags[bodies] = TAGS[prisms["semantic"]]
        point = cast.mount[:, 3] + rays[bodies] * hits["distance"][bodies][:, None]
        dx, dy = point[:, 0] - prisms["x"], point[:, 1] - prisms["y"]
        cos, sin = prisms["cos"], prisms["sin"]
        middle = 0.5 * (prisms["bottom"] + prisms["top"])
        half_height = 0.5 * (prisms["top"] - prisms["bottom"])
        depth = np.stack(
            [
                np.abs(dx * cos + dy * sin) - prisms["half_length"],
                np.abs(dy * cos - dx * sin) - prisms["half_width"],
                np.abs(point[:, 2] - middle) - half_height,
            ]
        )
        ray = rays[bodies]
        towards = np.stack(
            [
                np.abs(ray[:, 0] * cos + ray[:, 1] * sin),
                np.abs(ray[:, 1] * cos - ray[:, 0] * sin),
                np.abs(ray[:, 2]),
            ]
        )
        cosines[bodies] = np.take_along_axis(towards, depth.argmax(axis=0)[None], axis=0)[0]
    walls = what <= WALL_HIT
    if walls.any():
        wall = surroundings.panorama.walls[WALL_HIT - what[walls]]
        along = np.stack([wall["bx"] - wall["ax"], wall["by"] - wall["ay"]], axis=1)
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        ray = rays[walls]
        cosines[walls] = np.abs(ray[:, 0] * along[:, 1] - ray[:, 1] * along[:, 0])
        tags[walls] = _BUILDING_TAG
    return cosines, tags


def _lidar_head(angle: float, counts: NDArray[np.int64]) -> bytes:
    return struct.pack(f"<fI{len(counts)}I", angle, len(counts), *counts.tolist())


class LidarSensor:
    """A lidar with intensities."""

    kind: ClassVar[int] = 11

    def __init__(self, settings: SensorSettings) -> None:
        self._spin = _Spin(settings)
        self._range_m = settings.number("range", 0.1, 1000.0)
        self._attenuation = settings.number("atmosphere_attenuation_rate", 0.0)
        self._general = settings.number("dropoff_general_rate", 0.0, 1.0)
        self._limit = settings.number("dropoff_intensity_limit", 0.0, 1.0)
        self._at_zero = settings.number("dropoff_zero_intensity", 0.0, 1.0)
        self._noise_m = settings.number("noise_stddev", 0.0)
        self._random = settings.generator()

    def sense(self, context: SensorContext, actor: CarlaActor, elapsed_s: float) -> bytes:
        carrier = context.carrier_of(actor)
        scan = _Scan(context.surroundings, actor, carrier, self._spin, elapsed_s, self._range_m)
        intensity = np.exp(-self._attenuation * scan.distance)
        draws = self._random.random((2, *intensity.shape))
        share = np.minimum(intensity / self._limit, 1.0) if self._limit else 1.0
        kept = (scan.what != NO_HIT) & (draws[0] >= self._general)
        kept &= draws[1] >= self._at_zero * (1.0 - share)
        distance = scan.distance
        if self._noise_m:
            distance = np.maximum(
                distance + self._random.normal(0.0, self._noise_m, distance.shape), 0.0
            )
        points = np.empty((int(kept.sum()), 4), "<f4")
        points[:, :3] = scan.ways[kept] * distance[kept][:, None]
        points[:, 3] = intensity[kept]
        return _lidar_head(scan.angle, kept.sum(axis=1)) + points.tobytes()


SEMANTIC_POINT = np.dtype([("place", "<3f4"), ("cosine", "<f4"), ("actor", "<u4"), ("tag", "<u4")])


class SemanticLidarSensor:
    """A lidar with the tag and the actor of each point."""

    kind: ClassVar[int] = 10

    def __init__(self, settings: SensorSettings) -> None:
        self._spin = _Spin(settings)
        self._range_m = settings.number("range", 0.1, 1000.0)

    def sense(self, context: SensorContext, actor: CarlaActor, elapsed_s: float) -> bytes:
        carrier = context.carrier_of(actor)
        scan = _Scan(context.surroundings, actor, carrier, self._spin, elapsed_s, self._range_m)
        kept = scan.what != NO_HIT
        points = np.zeros(int(kept.sum()), SEMANTIC_POINT)
        points["place"] = scan.ways[kept] * scan.distance[kept][:, None]
        points["cosine"] = scan.cosines[kept]
        points["tag"] = context.tagged(scan.tags[kept], scan.ids[kept])
        points["actor"] = context.numbers_of(scan.ids[kept])
        return _lidar_head(scan.angle, kept.sum(axis=1)) + points.tobytes()


class RadarSensor:
    """Detections within a cone: radial speed, azimuth, altitude and distance."""

    kind: ClassVar[int] = 9

    def __init__(self, settings: SensorSettings) -> None:
        self._width = math.radians(settings.number("horizontal_fov", 0.1, 179.0))
        self._height = math.radians(settings.number("vertical_fov", 0.1, 179.0))
        self._range_m = settings.number("range", 0.1, 1000.0)
        self._points_per_s = settings.number("points_per_second", 1.0, _MAX_POINTS)
        self._random = settings.generator()

    def sense(self, context: SensorContext, actor: CarlaActor, elapsed_s: float) -> bytes:
        number = max(1, round(self._points_per_s * elapsed_s))
        channels = max(1, round(math.sqrt(number * self._height / self._width)))
        columns = max(1, number // channels)
        step = self._width / columns
        first = -0.5 * self._width + step * self._random.random()
        rows = (np.arange(channels) + self._random.random(channels)) / channels - 0.5
        cast = context.surroundings.cast(
            actor.pose,
            context.carrier_of(actor),
            (first, step, columns),
            rows * self._height,
            self._range_m,
        )
        hits = cast.hits
        found = hits["what"] != NO_HIT
        azimuth = np.broadcast_to((first + step * np.arange(columns))[:, None], found.shape)
        altitude = np.broadcast_to((rows * self._height)[None, :], found.shape)
        ways = np.stack(
            [
                np.cos(azimuth) * np.cos(altitude),
                -np.sin(azimuth) * np.cos(altitude),
                np.sin(altitude),
            ],
            axis=2,
        )
        speeds = context.velocities_of(hits["id"][found]) - np.array(actor.velocity)
        detections = np.empty((int(found.sum()), 4), "<f4")
        detections[:, 0] = (speeds @ axes_of(actor.pose) * ways[found]).sum(axis=1)
        detections[:, 1] = -azimuth[found]
        detections[:, 2] = altitude[found]
        detections[:, 3] = hits["distance"][found]
        return detections.tobytes()


class AttachedCamera:
    """Base class of the cameras. `picture`: the array that the kernel writes."""

    kind: ClassVar[int]
    picture: ClassVar[str]

    def __init__(self, settings: SensorSettings) -> None:
        width = settings.whole("image_size_x", 1, _MAX_PIXELS)
        height = settings.whole("image_size_y", 1, _MAX_PIXELS)
        fov = settings.number("fov", 0.1, 179.0)
        self.lens = Lens(self.picture, width, height, math.radians(fov), CAMERA_RANGE_M)
        self.head = struct.pack("<IIf", width, height, fov)

    def sense(self, context: SensorContext, actor: CarlaActor, elapsed_s: float) -> bytes:
        carrier = context.hidden_carrier_of(actor)
        picture = context.surroundings.take_picture(self.lens, actor.pose, carrier)
        pixels = np.full((self.lens.height, self.lens.width, 4), 255, np.uint8)
        self.fill(context, picture, pixels)
        return self.head + pixels.tobytes()

    def fill(
        self, context: SensorContext, picture: NDArray[Any], pixels: NDArray[np.uint8]
    ) -> None:
        """Write blue, green, red and alpha (H, W, 4) of a picture."""
        raise NotImplementedError

    def bodies(self, context: SensorContext) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
        """Return which pixels (H, W) show vehicles or walkers, and the vehicle id (n,) of each."""
        surroundings = context.surroundings
        prisms = surroundings.panorama.prisms
        body = (self.lens.picture_of(surroundings).face - FIRST_FACE) // _FACES_OF_PRISM
        shown = (body >= 0) & (body < len(prisms))
        return shown, prisms["id"][body[shown]]


class RgbCameraSensor(AttachedCamera):
    """Colours of classes, shaded."""

    kind = 13
    picture = "colours"

    def fill(
        self, context: SensorContext, picture: NDArray[Any], pixels: NDArray[np.uint8]
    ) -> None:
        pixels[..., :3] = picture[..., ::-1]


class DepthCameraSensor(AttachedCamera):
    """Depth along the optical axis, in 24 bits from 0 to 1000 m."""

    kind = 1
    picture = "depth"

    def fill(
        self, context: SensorContext, picture: NDArray[Any], pixels: NDArray[np.uint8]
    ) -> None:
        depth = np.where(picture < CAMERA_RANGE_M, picture, _DEPTH_RANGE_M)
        steps = (depth.astype(np.float64) / _DEPTH_RANGE_M * _DEPTH_STEPS).astype(np.uint32)
        for channel, shift in enumerate((16, 8, 0)):
            pixels[..., channel] = steps >> shift & 255


class SemanticCameraSensor(AttachedCamera):
    """The tag of each pixel, in red."""

    kind = 14
    picture = "classes"

    def fill(
        self, context: SensorContext, picture: NDArray[Any], pixels: NDArray[np.uint8]
    ) -> None:
        pixels[..., :2] = 0
        pixels[..., 2] = TAGS[picture]
        if context.session.actors.props.size:
            shown, ids = self.bodies(context)
            pixels[shown, 2] = context.tagged(pixels[shown, 2], ids)


class InstanceCameraSensor(SemanticCameraSensor):
    """The tag of each pixel in red, and the low 16 bits of its actor in green and blue."""

    kind = 15

    def fill(
        self, context: SensorContext, picture: NDArray[Any], pixels: NDArray[np.uint8]
    ) -> None:
        super().fill(context, picture, pixels)
        shown, ids = self.bodies(context)
        numbers = context.numbers_of(ids)
        pixels[shown, 1] = numbers & 255
        pixels[shown, 0] = numbers >> 8 & 255
