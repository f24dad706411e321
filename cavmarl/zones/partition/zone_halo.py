"""Halos: the areas that zones see beyond their borders.

A halo is a distance (decision 012): zones can receive ghosts of vehicles within this distance, even
from zones that do not touch them. `Visibility` leaves out vehicles that no driver considers.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.zones.kernels.zone_lookup import LOOK, WATCH, Halo
from cavmarl.zones.partition.zone_partition import ZonePartition

# Margin of the halo, so that rounding cannot make it too narrow.
_ROUNDING_M = 1e-6


def zone_halo(partition: ZonePartition, halo_m: float) -> Halo:
    """Return a halo for `ghost_exchange.exchange`; zones see all vehicles within `halo_m`."""
    if not (math.isfinite(halo_m) and halo_m >= 0.0):
        raise ConfigError(f"halo_m = {halo_m!r}: must be a finite number of at least 0")
    near = partition.within(halo_m)
    start = np.concatenate([[0], np.cumsum(near.sum(axis=1))]).astype(np.int32)
    return Halo(
        halo_m=float(halo_m),
        inner=inner_parts(partition, halo_m),
        near_start=start,
        near=np.nonzero(near)[1].astype(np.int32),
        sure_m=float(halo_m),
        seen_m=float(halo_m),
        line_m=math.inf,
        watcher_start=np.zeros(1, dtype=np.int32),
        watchers=np.zeros(0, dtype=WATCH),
    )


def lane_watchers(
    partition: ZonePartition,  # k zones
    lanes: NDArray[np.void],  # LANE (L,)
    looks: NDArray[np.void],  # LOOK (k, L), the vehicles that each zone's drivers may consider
    within_m: float,  # a zone within this distance of a lane's bounding box always watches it
) -> tuple[NDArray[np.int32], NDArray[np.void]]:
    """Return `watcher_start` and `watchers` of a `Halo`."""
    asked = looks["head"] > -np.inf
    for place in ("tail", "back", "line", "room", "merge"):
        asked |= looks[place] < np.inf
    min_x, min_y, max_x, max_y = partition.arrays.rects.T[:, :, None]
    dx = np.maximum(np.maximum(min_x - lanes["max_x"], lanes["min_x"] - max_x), 0.0)
    dy = np.maximum(np.maximum(min_y - lanes["max_y"], lanes["min_y"] - max_y), 0.0)
    watching = (asked | (hypot_all(dx, dy) <= within_m + _ROUNDING_M)).T
    start = np.concatenate([[0], np.cumsum(watching.sum(axis=1))])
    lane, zone = np.nonzero(watching)
    watchers = np.zeros(zone.size, dtype=WATCH)
    watchers["zone"] = zone
    for place in LOOK.names or ():
        watchers[place] = looks[place][zone, lane]
    return start.astype(np.int32), watchers


def inner_parts(partition: ZonePartition, seen_m: float) -> NDArray[np.float64]:
    """Return the part (k, 4) of each zone that is farther than `seen_m` from all other zones."""
    # With the margin, no other zone sees vehicles in this part, in spite of rounding.
    margin = seen_m + _ROUNDING_M
    inner: NDArray[np.float64] = partition.reaching + np.array([margin, margin, -margin, -margin])
    return inner
