"""The lanes of a world as they are now: with the limits and closures that differ from the map.

Worlds that may change lanes have a table LANE (W, L). Otherwise all worlds share the lanes of the
map, LANE (1, L).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel
from cavmarl.core.records.arrays import RoadArrays


@inlined_kernel
def table_of(lanes: NDArray[np.void], w: int) -> int:
    """Return the row of `Worlds.lanes` with the lanes of world w."""
    return w if lanes.shape[0] > 1 else 0


@inlined_kernel
def roads_in(roads: RoadArrays, lanes: NDArray[np.void], w: int) -> RoadArrays:
    """Return the roads of world w, with its lanes from `Worlds.lanes`."""
    own_lanes = lanes[table_of(lanes, w)]
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
