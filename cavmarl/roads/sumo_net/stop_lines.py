"""Where cars have to stop before a junction so that no vehicle that drives over it touches them.

Maps put the stop line at the end of a lane; some paths over the junction sweep across it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.sumo_net.conflicts import CLEARANCE_M, LinkPath, Poses, poses, touching

LINE_MARGIN_M = 1.0  # drivers stop this far before a line, see kernels.following
STEP_M = 0.5
MOST_M = 8.0
BODY_M = 5.0


def stop_back(
    ends: NDArray[np.float64],
    edge: NDArray[np.int32],
    from_lane: Sequence[int],
    junction: Sequence[int],
    paths: Sequence[LinkPath | None],
    approaches: Sequence[LinkPath | None],
) -> NDArray[np.float64]:
    """How far before its end a lane has its stop line, in m.

    Args:
        ends: (L, 4) x, y, z of each lane's end, m, and its direction there, rad.
        edge: (L,) EDGE row of each lane.
        from_lane: (K,) LANE row that each link leaves.
        junction: (K,) JUNCTION row of each link.
        paths: (K,) the path of each link, None where the map has none.
        approaches: (K,) the same with the last metres before the junction: vehicles from another
            road is asked about there, too.

    Returns:
        (L,), 0 for lanes that no path of another lane's links comes near. Where `MOST_M` is not
        enough, the lane keeps the map's line.
    """
    back = np.zeros(len(ends))
    at: dict[int, list[int]] = defaultdict(list)
    for link, row in enumerate(junction):
        if paths[link] is not None:
            at[row].append(link)
    for links in at.values():
        inside = {link: poses(path) for link in links if (path := paths[link]) is not None}
        coming = {link: poses(path) for link in links if (path := approaches[link]) is not None}
        for lane in {from_lane[link] for link in links}:
            others = [
                (inside if edge[from_lane[link]] == edge[lane] else coming)[link]
                for link in links
                if from_lane[link] != lane
            ]
            if others:
                back[lane] = _first_free(ends[lane], others)
    return back


def _first_free(end: NDArray[np.float64], others: Sequence[Poses]) -> float:
    x, y, z, heading = end
    for step in range(int(MOST_M / STEP_M) + 1):
        back = step * STEP_M
        centre = LINE_MARGIN_M + back + 0.5 * BODY_M
        body = Poses(
            np.array([[x - centre * np.cos(heading), y - centre * np.sin(heading), z]]),
            np.array([heading]),
        )
        if not any(_meets(body, other) for other in others):
            return back
    return 0.0


def _meets(body: Poses, other: Poses) -> bool:
    level = np.abs(other.xyz[:, 2] - body.xyz[0, 2]) <= CLEARANCE_M
    apart = other.xyz[level, :2] - body.xyz[0, :2]
    own = np.broadcast_to(body.heading, (int(level.sum()),))
    return bool(touching(apart, own, other.heading[level]).any())
