"""Which zones see over which borders.

Ghosts go by reach and not by contact (decision 012): the halo is a distance, and a zone gets every
vehicle within it, from neighbours or from far behind them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.errors import ZoneError
from cavmarl.kernels.zones import LOOK, Halo
from cavmarl.roads.zones import ZonePartition

__all__ = ["inner_parts", "zone_halo"]

# Added to the halo, so that no rounding of the sum below can make it too narrow.
_ROUNDING_M = 1e-6


def zone_halo(partition: ZonePartition, halo_m: float) -> Halo:
    """What `kernels.exchange.exchange` takes, where everybody within the halo is seen.

    Raises:
        ZoneError: `halo_m` is negative or not finite.
    """
    if not (math.isfinite(halo_m) and halo_m >= 0.0):
        raise ZoneError(f"halo_m = {halo_m!r}: must be a finite number from 0")
    rects = partition.reaching
    gaps = np.maximum(rects[:, None, :2] - rects[None, :, 2:], 0.0)
    gaps = np.maximum(gaps, gaps.swapaxes(0, 1))
    near = (gaps * gaps).sum(axis=2) <= halo_m * halo_m
    start = np.concatenate([[0], np.cumsum(near.sum(axis=1))]).astype(np.int32)
    nobody = np.zeros((0, 0), dtype=LOOK)
    return Halo(
        halo_m=float(halo_m),
        inner=inner_parts(partition, halo_m),
        near_start=start,
        near=np.nonzero(near)[1].astype(np.int32),
        sure_m=float(halo_m),
        looks=nobody,
        seen_m=float(halo_m),
    )


def inner_parts(partition: ZonePartition, seen_m: float) -> NDArray[np.float64]:
    """(k, 4) the part of each zone in which no other zone sees anybody that sees `seen_m` far."""
    # A little further in: whoever lies inside is out of every other zone's sight by any rounding.
    margin = seen_m + _ROUNDING_M
    inner: NDArray[np.float64] = partition.reaching + np.array([margin, margin, -margin, -margin])
    return inner
