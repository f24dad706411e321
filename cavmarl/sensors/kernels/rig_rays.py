"""Lidars and radars on agents' vehicles.

A radar target is a body or a building that at least one ray of the fan hits first. The nearest hit
of a target is its echo. The radial speed is the speed of the target's centre relative to the
sensor, along the ray, positive if the distance grows. The ground and clutter give no echo.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import hypot
from cavmarl.core.math.neighbors import Grid, fill_grid
from cavmarl.core.records import record
from cavmarl.core.records.arrays import Worlds
from cavmarl.roads.kernels.backdrop_pieces import Backdrop
from cavmarl.sensors.kernels.panorama import Panorama, gather
from cavmarl.sensors.kernels.ray_caster import WALL_HIT, Fan, cast
from cavmarl.sensors.kernels.rig_frames import Due, Noise, carries, error_of, sensor_key

TARGET = record(
    ("range", np.float64),  # m
    ("azimuth", np.float64),  # rad in the sensor's frame, positive to the left
    ("speed", np.float64),  # m/s, positive away
    ("body", np.int64),  # 1: body, 0: building
    ("id", np.int64),  # id of the vehicle, or number of the building
)


@kernel
def _radial_speed(fan: Fan, panorama: Panorama, ego: np.void, hit: np.void, a: int) -> float:
    """Return the radial speed of the object that column `a` has hit."""
    ray_x = fan.rays[a, 0, 0]
    ray_y = fan.rays[a, 0, 1]
    # The sensor moves with the vehicle, which turns about its centre.
    x = -(ego["speed"] - ego["yaw_rate"] * fan.mount[1, 3])
    y = -(ego["yaw_rate"] * fan.mount[0, 3])
    if hit["what"] >= 0:
        prism = panorama.prisms[hit["what"]]
        x += prism["speed"] * prism["cos"]
        y += prism["speed"] * prism["sin"]
    speed: float = x * ray_x + y * ray_y
    return speed


@kernel
def _place_of(targets: NDArray[np.void], found: int, body: int, number: int) -> int:
    """Return the index of a target in the list; `found` if the target is new."""
    for k in range(found - 1, -1, -1):
        if targets[k]["body"] == body and targets[k]["id"] == number:
            return k
    return found


@kernel
def _comes_before(target: np.void, other: np.void) -> bool:
    """Return whether a target comes before another: by range, then by kind and number."""
    if target["range"] != other["range"]:
        return bool(target["range"] < other["range"])
    if target["body"] != other["body"]:
        return bool(target["body"] > other["body"])
    return bool(target["id"] < other["id"])


@kernel
def detect(
    fan: Fan,
    panorama: Panorama,
    ego: np.void,
    hits: NDArray[np.void],
    targets: NDArray[np.void],
    order: NDArray[np.int32],
) -> int:
    """List the targets that the rays have hit, nearest first, and return their number.

    `fan`: rays of one channel. `hits`: HIT (A, 1), from `cast`. `targets`: TARGET (A,), overwritten
    up to the returned number, unordered. `order`: (A,), overwritten up to the same number with the
    indices of targets, nearest first.
    """
    found = 0
    for a in range(hits.shape[0]):
        hit = hits[a, 0]
        wall = WALL_HIT - hit["what"]
        if hit["what"] < 0 and wall < 0:
            continue
        body = 1 if hit["what"] >= 0 else 0
        number = hit["id"] if body == 1 else panorama.walls[wall]["building"]
        place = _place_of(targets, found, body, number)
        target = targets[place]
        if place == found or hit["distance"] < target["range"]:
            target["range"] = hit["distance"]
            target["azimuth"] = fan.first_rad + a * fan.step_rad
            target["speed"] = _radial_speed(fan, panorama, ego, hit, a)
            target["body"] = body
            target["id"] = number
        found = max(found, place + 1)
    for k in range(found):
        place = k
        while place > 0 and _comes_before(targets[k], targets[order[place - 1]]):
            order[place] = order[place - 1]
            place -= 1
        order[place] = k
    return found


# Rays are written in blocks of one cache line. Without blocks, and with 1,024 or more rays per
# layer, the same ray of all layers would map to one set of the cache, which cannot hold them.
BLOCK = 16


@kernel
def reach_of(fan: Fan) -> float:
    """Return the largest distance of a hit from the vehicle's position, m."""
    return fan.range_m + hypot(fan.mount[0, 3], fan.mount[1, 3])


@kernel
def measure_lidar(
    worlds: Worlds,
    grid: Grid,
    backdrop: Backdrop,
    due: Due,
    lines: NDArray[np.int32],
    noise: Noise,
    fan: Fan,
    panorama: Panorama,
    hits: NDArray[np.void],
    data: NDArray[np.float32],
) -> None:
    """Write the samples that are due for the owned agents.

    `lines`: (W, agents, 2) columns [first, last) of each agent's rays to write. `noise`: applies to
    hits only. `hits`: HIT (A, E), scratch. `data`: (W, agents, S, E, A) distances in m.
    """
    reach_m = reach_of(fan)
    noisy = noise.noise[0] > 0.0 or noise.bias[0] > 0.0
    for w in range(worlds.ticks.size):
        if due.num[w] == 0:
            continue
        rows = worlds.rows[w]
        fill_grid(rows, worlds.num_rows[w], grid)
        for i in range(worlds.num_owned[w]):
            row = rows[i]
            if not carries(due, row):
                continue
            counts = gather(rows, i, grid, backdrop, reach_m, False, panorama)
            first, last = lines[w, row["agent"], 0], lines[w, row["agent"], 1]
            cast(
                fan, panorama.prisms, counts.prisms, panorama.walls, counts.walls, first, last,
                hits,
            )  # fmt: skip
            out = data[w, row["agent"], due.slot[w]]
            for begin in range(first, last, BLOCK):
                end = min(begin + BLOCK, last)
                for e in range(hits.shape[1]):
                    for a in range(begin, end):
                        out[e, a] = hits[a, e]["distance"]
            if noisy:
                _add_noise(noise, row, worlds.ticks[w], fan.range_m, first, last, out)


@kernel
def _add_noise(
    noise: Noise,
    row: np.void,
    tick: int,
    range_m: float,
    first: int,
    last: int,
    out: NDArray[np.float32],
) -> None:
    """Add errors to distances (E, A) below the range, in the columns [first, last).

    The results lie between 0 and the range.
    """
    key = sensor_key(row, noise.stream)
    layers, rays = out.shape
    for e in range(layers):
        for a in range(first, last):
            if out[e, a] < range_m:
                error = error_of(noise, key, row["id"], tick, e * rays + a, 0)
                out[e, a] = min(max(out[e, a] + error, 0.0), range_m)


@kernel
def measure_radar(
    worlds: Worlds,
    grid: Grid,
    backdrop: Backdrop,
    due: Due,
    noise: Noise,
    fan: Fan,
    panorama: Panorama,
    hits: NDArray[np.void],
    targets: NDArray[np.void],
    order: NDArray[np.int32],
    data: NDArray[np.float32],
) -> None:
    """Write the samples that are due for the owned agents.

    `fan`: rays of one channel. `hits`: HIT (A, 1), scratch. `targets`: TARGET (A,), scratch.
    `order`: (A,), scratch. `data`: (W, agents, S, targets, 3) range in m, azimuth in rad, radial
    speed in m/s.
    """
    reach_m = reach_of(fan)
    for w in range(worlds.ticks.size):
        if due.num[w] == 0:
            continue
        rows = worlds.rows[w]
        fill_grid(rows, worlds.num_rows[w], grid)
        for i in range(worlds.num_owned[w]):
            row = rows[i]
            if not carries(due, row):
                continue
            counts = gather(rows, i, grid, backdrop, reach_m, False, panorama)
            cast(
                fan, panorama.prisms, counts.prisms, panorama.walls, counts.walls, 0,
                hits.shape[0], hits,
            )  # fmt: skip
            found = detect(fan, panorama, row, hits, targets, order)
            out = data[w, row["agent"], due.slot[w]]
            out[:] = 0.0
            key = sensor_key(row, noise.stream)
            for n in range(min(found, out.shape[0])):
                target = targets[order[n]]
                out[n, 0] = target["range"]
                out[n, 1] = target["azimuth"]
                out[n, 2] = target["speed"]
                for channel in range(3):
                    draw = 3 * n + channel
                    out[n, channel] += error_of(
                        noise, key, row["id"], worlds.ticks[w], draw, channel
                    )
