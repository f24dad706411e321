"""How fast traffic is on every edge: sampled, smoothed, and put in the place of the limits.

As SUMO's rerouting device does it (Behrisch, Krajzewicz, Wang: "Comparing performance and quality
of traffic assignment techniques for microscopic road traffic simulations", DTA 2008): the mean
speed of an edge's vehicles, averaged over the last samples. Everything that is summed is whole
millimetres a second, so that no result depends on the order of rows or of parts of a map.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import kernel
from cavmarl.core.records.arrays import RoadArrays
from cavmarl.core.records.codes import DRIVER_SCRIPTED

CLOSED_S = 1e9  # time to drive along a closed lane: any way around it is faster
LEAST_MPS = 0.001  # nothing is slower, so that a jam has a travel time


@kernel
def _millimetres(speed: float) -> int:
    return int(max(speed, 0.0) * 1000.0 + 0.5)


@kernel
def limit_speeds(roads: RoadArrays, past: NDArray[np.int32], speed_sums: NDArray[np.int64]) -> None:
    """Let all samples be what an empty map has.

    `past`: (N, num_edges) mm/s, written. `speed_sums`: (num_edges,) mm/s, written: the sums over
    the N samples.
    """
    for edge in range(roads.edges.shape[0]):
        row = roads.edges[edge]
        total = 0
        for lane in range(row["first_lane"], row["first_lane"] + row["num_lanes"]):
            total += _millimetres(roads.lanes[lane]["speed_mps"])
        mean = total // row["num_lanes"]
        past[:, edge] = mean
        speed_sums[edge] = mean * past.shape[0]


@kernel
def sample_speeds(
    roads: RoadArrays,
    rows: NDArray[np.void],
    num: int,
    number: int,
    past: NDArray[np.int32],
    speed_sums: NDArray[np.int64],
    lane_counts: NDArray[np.int64],
    lane_sums: NDArray[np.int64],
) -> None:
    """Sample the mean speed of every edge; the sample takes the place of the oldest one.

    A lane without vehicles counts as one vehicle at its limit; vehicles that make a stop or follow
    a script do not count.

    `number`: of the sample, since the reset. `past`: (N, num_edges) the last samples in mm/s.
    `speed_sums`: (num_edges,) their sums. `lane_counts`: (L,) room. `lane_sums`: (L,) room.
    """
    lane_counts[:] = 0
    lane_sums[:] = 0
    for i in range(num):
        if rows[i]["stopped_s"] > 0.0 or rows[i]["driver"] == DRIVER_SCRIPTED:
            continue
        lane_counts[rows[i]["lane"]] += 1
        lane_sums[rows[i]["lane"]] += _millimetres(rows[i]["speed"])
    oldest = number % past.shape[0]
    for edge in range(roads.edges.shape[0]):
        row = roads.edges[edge]
        total = 0
        count = 0
        for lane in range(row["first_lane"], row["first_lane"] + row["num_lanes"]):
            if lane_counts[lane] == 0:
                total += _millimetres(roads.lanes[lane]["speed_mps"])
                count += 1
            else:
                total += lane_sums[lane]
                count += lane_counts[lane]
        mean = total // count
        speed_sums[edge] += mean - past[oldest, edge]
        past[oldest, edge] = mean


@kernel
def slow_lanes(
    roads: RoadArrays,
    speed_sums: NDArray[np.int64],
    samples: int,
    closed: NDArray[np.int64],
    permission: int,
    lanes: NDArray[np.void],
) -> None:
    """Write speeds into a copy of the lanes, so that plans over it see how traffic is now.

    Args:
        roads: the road arrays.
        speed_sums: (num_edges,) mm/s, see `sample_speeds`.
        samples: how many samples a sum has; 0: the limits are what counts.
        closed: (num_edges,) bits of the classes that an edge is closed to.
        permission: bits of the class that drives.
        lanes: LANE (L,), of which "speed_mps" is written.
    """
    for lane in range(lanes.shape[0]):
        row = roads.lanes[lane]
        edge = row["edge"]
        speed = row["speed_mps"]
        if samples > 0:
            speed = min(speed, max(speed_sums[edge] / (1000.0 * samples), LEAST_MPS))
        if closed[edge] & permission == permission:
            speed = row["length_m"] / CLOSED_S
        lanes[lane]["speed_mps"] = speed
