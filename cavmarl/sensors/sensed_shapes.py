"""Sensor data of an agent as shapes that the viewer page draws.

A shape is a JSON object with `name` (of the sensor), `kind` and `axes`: `vehicle` (origin at the
vehicle's centre, x forward, y left) or `map` (same origin, x east, y north). Positions are in
metres.

| kind | fields |
|---|---|
| `rays` | `from` [x, y], `ends` [x, y, x, y, …], `hits`: 1 where a ray ends at an object |
| `points` | `points` [x, y, …] |
| `links` | as `points`, with a line from the vehicle to each point |
| `picture` | `width`, `height`, `rgba` (base64); `cone` [x, y, yaw_rad, opening_rad, range_m] |
| `grid` | a picture on the ground; `corners`: both ends of the first row, start of the last row |
| `numbers` | `rows`: pairs [unit, number] |
"""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.rig import BevGridConfig, CameraConfig, LidarRigConfig, MountedConfig
from cavmarl.config.sensors import OccupancyGridConfig
from cavmarl.sensors.kernels.camera_picture import colours
from cavmarl.sensors.kernels.panorama import LANE_LINE
from cavmarl.sensors.mounted.lidar import has_echo, lidar_directions
from cavmarl.sensors.mounted.mount_transforms import mount_of, sensor_to_vehicle
from cavmarl.sensors.observed import layout

MOST_RAYS = 360
MOST_POINTS = 2000
MOST_PIXELS = 64_000
# Units of positions; `GnssConfig.units` has the units of the noise.
GNSS_UNITS = ("° latitude", "° longitude", "m above the ellipsoid")

Shape = dict[str, Any]
Floats = NDArray[np.float64]


def observed_shapes(config: EnvConfig, observation: NDArray[np.float32]) -> list[Shape]:
    """Return the shapes of an agent's observation (D,), from the newest frame of a stack."""
    shapes: list[Shape] = []
    if config.observation.mode == "sensors":
        return shapes
    sensors = config.sensors
    frame = observation[-(len(observation) // sensors.stack) :].astype(np.float64)
    parts = {name: frame[part] for name, part in layout(sensors).items()}
    if "lidar" in parts:
        distances = parts["lidar"][: sensors.lidar.rays]
        angles = 2.0 * np.pi * np.arange(len(distances)) / len(distances)
        shapes.append(_rays("lidar", distances, angles, sensors.lidar.range_m))
    if "lidar_observation" in parts:
        settings = sensors.lidar_observation
        distances = parts["lidar_observation"].reshape(-1, 2)[:, 0]
        distances = distances if settings.normalize else distances / settings.maximum_range_m
        angles = -2.0 * np.pi * np.arange(len(distances)) / len(distances)
        reach = settings.maximum_range_m
        shapes.append(_rays("lidar_observation", distances, angles, reach, axes="map"))
    if "neighbors" in parts:
        rows = parts["neighbors"].reshape(-1, 7)
        seen = rows[rows[:, 0] > 0.5, 1:3] * sensors.neighbors.range_m
        shapes.append(_places("neighbors", "links", seen))
    if "route" in parts:
        scale = sensors.route.points * sensors.route.spacing_m
        shapes.append(_places("route", "points", parts["route"].reshape(-1, 2) * scale))
    if "occupancy_grid" in parts:
        shapes.append(_occupancy(sensors.occupancy_grid, parts["occupancy_grid"]))
    return shapes


def _rays(
    name: str, shares: Floats, angles: Floats, range_m: float, axes: str = "vehicle"
) -> Shape:
    """Make rays from the vehicle's centre; `shares`: lengths of the rays divided by the range."""
    reach = np.clip(shares, 0.0, 1.0) * range_m
    ends = np.stack([np.cos(angles) * reach, np.sin(angles) * reach], axis=1)
    return _ray_shape(name, np.zeros(2), ends, has_echo(reach, range_m), axes)


def _ray_shape(
    name: str, start: Floats, ends: Floats, hits: NDArray[np.bool_], axes: str = "vehicle"
) -> Shape:
    some = slice(None, None, max(1, -(-len(ends) // MOST_RAYS)))
    return {
        "name": name,
        "kind": "rays",
        "axes": axes,
        "from": _flat(start),
        "ends": _flat(ends[some]),
        "hits": hits[some].astype(int).tolist(),
    }


def _places(name: str, kind: str, places: Floats) -> Shape:
    some = places[:: max(1, -(-len(places) // MOST_POINTS))]
    return {"name": name, "kind": kind, "axes": "vehicle", "points": _flat(some)}


def _flat(places: Floats) -> list[float]:
    """Return a flat list of finite numbers, because JSON cannot hold nan or infinity."""
    numbers: list[float] = np.nan_to_num(np.round(places, 2)).ravel().tolist()
    return numbers


def _occupancy(settings: OccupancyGridConfig, numbers: Floats) -> Shape:
    """Colour vehicles orange and roads grey; the other layers are not shown."""
    columns, rows = settings.shape
    layers = numbers.reshape(len(settings.features), columns, rows)
    shades = np.abs(layers / 255.0 - 0.5 if settings.as_image else layers)
    shades *= 2.0 if settings.as_image else 1.0
    rgba = np.zeros((rows, columns, 4), np.uint8)
    for feature, layer in zip(settings.features, np.clip(shades, 0.0, 1.0), strict=True):
        filled = layer.T > 1e-3
        color = (255, 140, 40) if feature == "presence" else (120, 130, 145)
        if feature in ("presence", "on_road"):
            fresh = filled if feature == "presence" else filled & (rgba[..., 3] == 0)
            rgba[fresh] = (*color, 150)
    (low_x, _), (low_y, _) = settings.grid_size_m
    step_x, step_y = settings.grid_step_m
    # highway-env's y axis points right of its x axis.
    left, right, top, bottom = low_x, low_x + columns * step_x, -low_y, -(low_y + rows * step_y)
    corners = np.array([[left, top], [right, top], [left, bottom]])
    axes = "vehicle" if settings.align_to_vehicle_axes else "map"
    return _grid("occupancy_grid", rgba, corners, axes)


def _grid(name: str, rgba: NDArray[np.uint8], corners: Floats, axes: str = "vehicle") -> Shape:
    return {
        "name": name,
        "kind": "grid",
        "axes": axes,
        "corners": _flat(corners),
        **_pixels(rgba),
    }


def sampled_shapes(name: str, settings: MountedConfig, data: NDArray[Any]) -> list[Shape]:
    """Return the shapes of one sample of a mounted sensor."""
    if isinstance(settings, LidarRigConfig):
        return [_lidar(name, settings, data.astype(np.float64))]
    if settings.type == "radar":  # type: ignore[attr-defined]
        rows = data[data[:, 0] > 0.0].astype(np.float64)
        flat = np.stack([np.cos(rows[:, 1]), np.sin(rows[:, 1])], axis=1) * rows[:, :1]
        return [_places(name, "points", _in_vehicle(settings, flat))]
    if isinstance(settings, CameraConfig):
        mount = mount_of(settings)
        yaw = math.atan2(mount.turn[1, 0], mount.turn[0, 0])
        cone = [*mount.place[:2].tolist(), yaw, math.radians(settings.fov_deg), settings.range_m]
        shown = _pixels(_colored(settings, data))
        return [{"name": name, "kind": "picture", "axes": "vehicle", "cone": cone, **shown}]
    if isinstance(settings, BevGridConfig):
        ahead, behind = settings.ahead_m, settings.behind_m
        aside = settings.aside_m
        corners = np.array([[ahead, aside], [ahead, -aside], [-behind, aside]])
        rgba = _colored(settings, data)
        rgba[..., 3] = np.where(data > 0, 150, 0)
        return [_grid(name, rgba, _in_vehicle(settings, corners))]
    numbers = np.nan_to_num(data.astype(np.float64)).ravel()
    units = GNSS_UNITS if settings.type == "gnss" else getattr(settings, "units", ())  # type: ignore[attr-defined]
    lines = [[unit, round(float(value), 4)] for unit, value in zip(units, numbers, strict=False)]
    return [{"name": name, "kind": "numbers", "rows": lines}]


def _lidar(name: str, settings: LidarRigConfig, distances: Floats) -> Shape:
    """Draw a lidar with one layer as rays, and a lidar with several layers as points."""
    directions = lidar_directions(
        settings.fov_deg, settings.rays, settings.lower_deg, settings.upper_deg, settings.layers
    )
    mount = mount_of(settings)
    ends = sensor_to_vehicle(mount, (directions * distances[..., None]).reshape(-1, 3))[:, :2]
    hits = has_echo(distances.ravel(), settings.range_m)
    if settings.layers == 1:
        return _ray_shape(name, mount.place[:2], ends, hits)
    return _places(name, "points", ends[hits])


def _in_vehicle(settings: MountedConfig, places: Floats) -> Floats:
    """Transform points (n, 2) in the sensor's plane to the vehicle's frame."""
    flat = np.concatenate([places, np.zeros((len(places), 1))], axis=1)
    return sensor_to_vehicle(mount_of(settings), flat)[:, :2]


def _colored(settings: MountedConfig, data: NDArray[Any]) -> NDArray[np.uint8]:
    """Return a picture (height, width, 4): colours as given, classes by palette, depths in grey."""
    every = max(1, math.ceil(math.sqrt(data.shape[0] * data.shape[1] / MOST_PIXELS)))
    data = data[::every, ::every]
    rgba = np.full((*data.shape[:2], 4), 255, np.uint8)
    if data.ndim == 3:
        rgba[..., :3] = data
    elif isinstance(settings, CameraConfig) and settings.units == ("m",):
        near = 1.0 - np.clip(data.astype(np.float64) / settings.range_m, 0.0, 1.0)
        rgba[..., :3] = (255.0 * near**2)[..., None]
    else:
        shades = colours()
        shades[LANE_LINE] = 230.0
        rgba[..., :3] = shades[data]
    return rgba


def _pixels(rgba: NDArray[np.uint8]) -> dict[str, Any]:
    height, width = rgba.shape[:2]
    return {"width": width, "height": height, "rgba": base64.b64encode(rgba.tobytes()).decode()}
