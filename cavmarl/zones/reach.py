"""Distances that a shard must see beyond its borders: drivers' reach and the longest move.

Distances are between centres, in the plane. Distances along a road are at least as long, except
over junctions without internal lanes, where vehicles jump.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary import hypot, sine
from cavmarl.core.math.elementary_arrays import atan2_all, hypot_all
from cavmarl.core.records.arrays import TripTables
from cavmarl.core.records.rows import LOST_M, MERGES_M
from cavmarl.driving.kernels.junctions.junctions import EXIT_LOOK_M
from cavmarl.driving.kernels.junctions.stop_line_registration import APPROACH_M
from cavmarl.driving.kernels.motion.motion import CROSSINGS_PER_TICK, LATERAL_MPS, MAX_SPEED_MPS
from cavmarl.roads.network import RoadNetwork

ASIDE_M = 10.0  # limit of the distance of the centres of adjacent lanes, and of vehicles on them


def driving_reach_m(network: RoadNetwork, travel: TripTables) -> float:
    """Return the distance of the farthest vehicle on which a driver's decision can depend.

    A driver looks `view_m` ahead. On a junction, or with a stop line within `see_m`, it also
    considers vehicles that approach the junction and vehicles after it. A vehicle approaches if it
    is on the junction, or on a lane that leads to the junction, at most `APPROACH_M` before the end
    of its lane (`MERGES_M` where vehicles turn into a lane). Vehicles after the junction count up
    to `EXIT_LOOK_M`.
    """
    longest_m = float(network.links["length_m"].max(initial=0.0))
    junction_m = max(travel.see_m, longest_m)
    merges_m = MERGES_M if network.lanes["merges"].any() else 0.0
    beyond_m = max(APPROACH_M, merges_m, EXIT_LOOK_M, longest_m)
    stretch, jump_m = _jumps(network)
    bodies_m = 2.0 * float(travel.types["length"].max())
    roads_m = stretch * max(travel.view_m, junction_m + beyond_m) + 2.0 * jump_m
    return roads_m + _across_m(network) + bodies_m + ASIDE_M + travel.scripts.reach_m


def longest_move_m(network: RoadNetwork, travel: TripTables, dt: float) -> float:
    """Return an upper bound, in m, of a vehicle's move in a tick of `dt` seconds.

    The bound includes the motion along the lane at the highest possible speed, the lateral motion
    of a lane change, and jumps at kinks of the map's lines and at junctions. In a hairpin, the
    centre of a body is on the chord between its bumpers, up to half its length off the lane.
    """
    _, jump_m = _jumps(network)
    shortest_m = float(network.lanes["length_m"].min())
    jumps = 1 + min(int(MAX_SPEED_MPS * dt / max(shortest_m, 1e-9)), CROSSINGS_PER_TICK - 1)
    way_m = hypot(MAX_SPEED_MPS, LATERAL_MPS) * dt
    half_m = 0.5 * float(travel.types["length"].max())
    return way_m + _kink_m(network) + jumps * jump_m + half_m


def off_lane_m(network: RoadNetwork, travel: TripTables) -> float:
    """Return an upper bound, in m, of the distance of a body's centre from its lane's centre line.

    The bound includes a lane's width during a lane change, half a body's length in a bend, and a
    jump between the bumpers on a junction without internal lanes. Agents may be farther away, but
    at most `LOST_M`.
    """
    _, jump_m = _jumps(network)
    half_m = 0.5 * float(travel.types["length"].max())
    return max(LOST_M, float(network.lanes["width_m"].max(initial=0.0)) + half_m + jump_m)


def _kink_m(network: RoadNetwork) -> float:
    """Return how far a point one lane's width beside a lane's line can jump at a kink."""
    lanes, links = network.lanes, network.links
    direction = np.stack([network.points["cos"], network.points["sin"]], axis=1)
    first = lanes["first_point"]
    last = first + lanes["num_points"] - 2  # first point of the last segment
    within = np.ones(len(direction), dtype=bool)
    within[last + 1] = False  # the next point belongs to another lane
    within = np.flatnonzero(within)
    before = [direction[within], direction[last[links["from_lane"]]]]
    after = [direction[within + 1], direction[first[links["next_lane"]]]]
    inside = np.flatnonzero(lanes["internal"])
    before.append(direction[last[inside]])
    after.append(direction[first[lanes["successor"][inside]]])
    cos, sin = np.concatenate(before).T
    next_cos, next_sin = np.concatenate(after).T
    turn = np.abs(atan2_all(cos * next_sin - sin * next_cos, cos * next_cos + sin * next_sin))
    widest_m = float(lanes["width_m"].max(initial=0.0))
    return 2.0 * sine(0.5 * float(turn.max(initial=0.0))) * widest_m


def _ends(network: RoadNetwork) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the start and the end of each lane, (L, 2) each."""
    first = network.lanes["first_point"]
    points = np.stack([network.points["x"], network.points["y"]], axis=1)
    return points[first], points[first + network.lanes["num_points"] - 1]


def _across_m(network: RoadNetwork) -> float:
    """Return the largest distance from a lane's end to its exit or to a foe's lane."""
    links = network.links
    starts, ends = _ends(network)
    leaves = ends[links["from_lane"]]
    through = leaves - starts[links["to_lane"]]
    rows = np.arange(len(links))
    between = [
        leaves[np.repeat(rows, links[number])] - leaves[table["foe"]]
        for number, table in (
            ("num_conflicts", network.conflicts),
            ("num_sweeps", network.sweeps),
        )
    ]
    apart = np.concatenate([through, *between])
    return float(hypot_all(apart[:, 0], apart[:, 1]).max(initial=0.0))


def _jumps(network: RoadNetwork) -> tuple[float, float]:
    """Return the largest ratio of plane to road distance, and the longest jump in m."""
    links = network.links[network.links["first_internal"] < 0]
    starts, ends = _ends(network)
    jump = ends[links["from_lane"]] - starts[links["to_lane"]]
    jump_m = hypot_all(jump[:, 0], jump[:, 1])
    stretch = 1.0 + jump_m / network.lanes["length_m"][links["from_lane"]]
    return float(stretch.max(initial=1.0)), float(jump_m.max(initial=0.0))
