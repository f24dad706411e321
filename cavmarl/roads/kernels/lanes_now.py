"""The present lanes of a world, with speed limits and closures that differ from the map.

Table 0 of LANE (V, L) has the lanes of the map. If worlds may modify lanes, table 1 + w has the
lanes of world w, and V is 1 + W. Otherwise V is 1, and all worlds share table 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel
from cavmarl.core.records.arrays import RoadArrays


@inlined_kernel
def shares_lanes(lanes: NDArray[np.void]) -> bool:
    """Return whether all worlds share the lanes of the map.

    In most worlds they do. Kernels then use the roads of the map, because `roads_in` is slower.
    """
    return len(lanes) == 1


@inlined_kernel
def table_of(lanes: NDArray[np.void], w: int) -> int:
    """Return the row of `Worlds.lanes` with the lanes of world w."""
    return 0 if shares_lanes(lanes) else 1 + w


@inlined_kernel
def plans_of(plans: NDArray[np.void], row: np.void, w: int) -> int:
    """Return the table in PLAN (V, G, L) that an agent's vehicle of world w follows.

    Table 0 has the plans on the lanes of the map. If worlds may modify lanes, table 1 + w has the
    plans of world w, which its vehicles adopt once a second (`traffic.kernels.own_plans`).
    """
    if plans.shape[0] == 1 or row["way"] == row["goal"] * plans.shape[2]:
        return 0
    return 1 + w


@inlined_kernel
def is_closed(roads: RoadArrays, lane: int, kind: np.void) -> bool:
    """Return whether a lane is closed to vehicles of a VTYPE; `roads`: the roads of the world."""
    closed: bool = roads.lanes[lane]["permissions"] & kind["permissions"] == 0
    return closed


@inlined_kernel
def roads_in(roads: RoadArrays, lanes: NDArray[np.void], w: int) -> RoadArrays:
    """Return the roads of a world w that does not share lanes, with lanes from `Worlds.lanes`."""
    own_lanes = lanes[1 + w]
    return RoadArrays(
        points=roads.points,
        lanes=own_lanes,
        edges=roads.edges,
        links=roads.links,
        conflicts=roads.conflicts,
        sweeps=roads.sweeps,
        into=roads.into,
        signals=roads.signals,
        programs=roads.programs,
        phases=roads.phases,
        phase_states=roads.phase_states,
        switches=roads.switches,
        detectors=roads.detectors,
        phase_detectors=roads.phase_detectors,
        lane_place=roads.lane_place,
        places=roads.places,
        maps=roads.maps,
    )
