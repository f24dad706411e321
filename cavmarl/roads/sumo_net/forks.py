"""How far the movements out of one lane share their way."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.rows import FORK_BEYOND_M
from cavmarl.roads.sumo_net.conflicts import NEAR_M, LinkPath


def fork_lengths(from_lane: Sequence[int], paths: Sequence[LinkPath | None]) -> NDArray[np.float64]:
    """The length of each link's path that lies near another one's from the same lane, in m.

    Args:
        from_lane: (K,) LANE row that each link leaves.
        paths: (K,) the path of each link, None where the map has none.
    """
    lengths = np.zeros(len(paths))
    leaving: dict[int, list[int]] = defaultdict(list)
    for link, lane in enumerate(from_lane):
        leaving[lane].append(link)
    for links in leaving.values():
        for link in links:
            path = paths[link]
            others = [other for k in links if k != link and (other := paths[k]) is not None]
            if path is not None and others:
                lengths[link] = max(_shared_m(path, other) for other in others)
    return lengths


def _shared_m(path: LinkPath, other: LinkPath) -> float:
    apart = path.xyz[:, None, :2] - other.xyz[None, :, :2]
    nearest = (apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1]).min(axis=1)
    parted = np.flatnonzero(nearest > NEAR_M * NEAR_M)
    return float(path.s[parted[0]]) if parted.size else float(path.s[-1]) + FORK_BEYOND_M
