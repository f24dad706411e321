"""The parts of lanes that each zone watches, as LOOK records."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.zones.kernels.zone_lookup import LOOK, Halo

__all__ = ["blank_looks", "looks_of"]


def blank_looks(shape: int | tuple[int, ...]) -> NDArray[np.void]:
    """Return LOOK records that watch no part of a lane."""
    looks = np.zeros(shape, dtype=LOOK)
    looks["head"] = -np.inf
    for place in ("tail", "back", "line", "room", "merge"):
        looks[place] = np.inf
    return looks


def looks_of(halo: Halo, zone: int) -> NDArray[np.void]:
    """Return LOOK (lanes,), the parts of lanes that a zone watches."""
    looks = blank_looks(len(halo.watcher_start) - 1)
    for lane, look in enumerate(looks):
        watchers = halo.watchers[halo.watcher_start[lane] : halo.watcher_start[lane + 1]]
        for watch in watchers[watchers["zone"] == zone]:
            for field in LOOK.names or ():
                look[field] = watch[field]
    return looks
