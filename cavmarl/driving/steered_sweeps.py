"""Swept areas of steered cars, for the maps of worlds with agents.

Background vehicles have both bumpers on their paths. A steered car, whose axles are at its bumpers,
turns late: in a bend, its front is outside and its rear inside of the path. So this module drives a
car over the links in advance, and describes in SWEEP rows where it meets vehicles on other links.
Only the built-in drivers of agents' vehicles read these rows.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.action import ActionConfig
from cavmarl.core.records.rows import SIZE_BODIES_M, STEERED
from cavmarl.driving.kernels.motion.steered_drive import steered_poses
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.roads.cache import derived_network
from cavmarl.roads.network import SWEEP, RoadNetwork
from cavmarl.roads.routing import PLAN, lane_grid
from cavmarl.roads.sumo_net.conflicts import LinkPath, sample_path
from cavmarl.roads.sumo_net.sweeps import (
    AHEAD_M,
    BEFORE_M,
    BEYOND_M,
    BODIES,
    Movements,
    SweptBody,
    find_pair,
    is_near,
    poses_on_rails,
)

LENGTH_M, WIDTH_M = 5.0, 2.0
HALF_M = 0.5 * SIZE_BODIES_M[0]
BODY = SweptBody(HALF_M, 0.5 * WIDTH_M + 0.25)
TICKS_S = (0.05, 0.1)  # tick lengths of the drives; in longer ticks, a car drives further out
SETTLE_M = 20.0  # additional start distance, so that the car reaches the speed of the bend
MOST_POSES = 2000
FORMAT = "steered-4"  # change this version if the rows of a map change


def load_steered(path: str | Path) -> RoadNetwork:
    """Return the network of a map file with SWEEP rows of steered cars, from a cache on disk.

    Raises MapError: see `read_network`.
    """
    return derived_network(path, FORMAT, with_steered_sweeps)


def with_steered_sweeps(network: RoadNetwork) -> RoadNetwork:
    """Return a map with SWEEP rows of steered cars in addition to its own SWEEP rows."""
    # Copy bytes: copies of arrays would leave the padding of the records undefined.
    links = np.frombuffer(bytearray(network.links.tobytes()), dtype=network.links.dtype)
    ways = [_way(network, link) for link in range(len(links))]
    movements = Movements(links, network.conflicts, ways)
    found = _rows(network, movements)
    own = np.split(network.sweeps, links["first_sweep"][1:]) if len(links) else []
    parts: list[bytes] = []
    for link, (old, rows) in enumerate(zip(own, found, strict=True)):
        # Behind a vehicle that makes a U-turn, a steered car waits like any other car.
        behind = links["from_lane"][old["foe"]] == links["from_lane"][link]
        rows += [(int(k["foe"]), STEERED, *k.item()[2:]) for k in old[behind & (old["own"] == 0)]]
        new = np.zeros(len(rows), SWEEP)
        new[:] = sorted(rows)
        parts += [old.tobytes(), new.tobytes()]
    counts = np.array([len(rows) for rows in found], dtype=np.int32) + links["num_sweeps"]
    links["num_sweeps"] = counts
    links["first_sweep"] = np.concatenate([[0], np.cumsum(counts)[:-1]]) if len(links) else 0
    sweeps = np.frombuffer(bytearray(b"".join(parts)), dtype=SWEEP)
    return replace(network, links=links, sweeps=sweeps)


def _rows(network: RoadNetwork, movements: Movements) -> list[list[tuple[float, ...]]]:
    """Return the SWEEP rows of each link."""
    by_junction: dict[int, list[int]] = defaultdict(list)
    for link, way in enumerate(movements.ways):
        if way is not None:
            by_junction[int(movements.links["junction"][link])].append(link)
    found: list[list[tuple[float, ...]]] = [[] for _ in movements.ways]
    drive = _Drive(network)
    for links in by_junction.values():
        rails, steered = {}, {}
        for link in links:
            way = movements.ways[link]
            assert way is not None
            length = float(movements.links["length_m"][link])
            rails[link] = [poses_on_rails(way, body.half_m, length) for body in BODIES]
        for one, other in combinations(links, 2):
            apart = movements.links["from_lane"][one] != movements.links["from_lane"][other]
            if not apart or not is_near(rails[one][0], rails[other][0]):
                continue
            for link in (one, other):
                if link not in steered:
                    steered[link] = drive.poses(link)
            for mine, theirs in ((one, other), (other, one)):
                for foe, body in enumerate(BODIES):
                    here = steered[mine], BODY
                    row = find_pair(movements, (mine, theirs), here, (rails[theirs][foe], body))
                    if row is not None:
                        found[mine].append((theirs, STEERED, foe, *row[0], *row[1]))
            both = find_pair(movements, (one, other), (steered[one], BODY), (steered[other], BODY))
            if both is not None:
                found[one].append((other, STEERED, STEERED, *both[0], *both[1]))
                found[other].append((one, STEERED, STEERED, *both[1], *both[0]))
    return found


def _way(network: RoadNetwork, link: int) -> LinkPath | None:
    """Return a link's path with parts of the lanes at both ends; None without internal lanes."""
    row = network.links[link]
    if row["first_internal"] < 0:
        return None
    part = network.lane_points(int(row["from_lane"]))
    length = float(network.lanes["length_m"][row["from_lane"]])
    near = part["s"] > length - AHEAD_M
    near[np.flatnonzero(near)[0] - 1 if near.any() and not near[0] else 0] = True
    s, points = [part["s"][near] - length], [part[near]]
    lane = int(row["first_internal"])
    while network.lanes["internal"][lane]:
        s.append(network.lane_points(lane)["s"] + network.lanes["link_offset_m"][lane])
        points.append(network.lane_points(lane))
        lane = int(network.lanes["successor"][lane])
    part = network.lane_points(lane)
    near = part["s"] < AHEAD_M
    near[: min(int(near.sum()) + 1, len(near))] = True
    s.append(part["s"][near] + float(row["length_m"]))
    points.append(part[near])
    xyz = np.concatenate([np.column_stack([part[axis] for axis in "xyz"]) for part in points])
    return sample_path(np.concatenate(s), xyz)


class _Drive:
    """Drives a car over the links of a map."""

    def __init__(self, network: RoadNetwork) -> None:
        self._network = network
        self._grid = lane_grid(network)
        self._plan = np.zeros((1, len(network.lanes)), dtype=PLAN)
        self._plan["next"] = network.lanes["successor"]
        self._plan["link"] = -1
        self._poses = np.empty((MOST_POSES, 6))

    def poses(self, link: int) -> NDArray[np.float64]:
        """Return the poses (n, 6) of the car on a link, in the form of `poses_on_rails`."""
        network, lane = self._network, int(self._network.links["from_lane"][link])
        self._plan["next"][0, lane] = network.links["first_internal"][link]
        self._plan["link"][0, lane] = link
        row = blank_vehicle()[0]
        row["length"], row["width"] = LENGTH_M, WIDTH_M
        found = []
        for dt in TICKS_S:
            number = steered_poses(
                network.arrays, self._plan, self._grid, row, LENGTH_M, ActionConfig().steering_rad,
                link, BEFORE_M + HALF_M + SETTLE_M, BEYOND_M + HALF_M, dt, self._poses,
            )  # fmt: skip
            found.append(self._poses[:number].copy())
        self._plan["next"][0, lane] = self._plan["link"][0, lane] = -1
        poses = np.concatenate(found)
        return poses[poses[:, 0] >= -(BEFORE_M + HALF_M)]
