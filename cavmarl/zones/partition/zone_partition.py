"""`ZonePartition`: a map divided into rectangles, so that each position is in exactly one zone.

Zones are half-open: [min_x, max_x) by [min_y, max_y). So a position on a border or at a corner
belongs to one zone. Zones at the rim extend to infinity, so even positions outside of the map have
a zone. `zone_layouts` makes partitions of maps, `zone_file` stores them, `zone_halo` computes how
far zones see beyond their borders, and `zone_statistics` describes their contents.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.zones.kernels.zone_lookup import ZoneArrays, zones_of

Bounds = tuple[float, float, float, float]  # min_x, min_y, max_x, max_y in metres

_PLACE = np.dtype([("x", np.float64), ("y", np.float64)])


@dataclass(frozen=True)
class Neighbor:
    """A zone that touches another zone."""

    zone: int
    corner: bool  # whether they share only a corner


@dataclass(frozen=True, eq=False)
class ZonePartition:
    """k zones, numbered from 0, that cover the plane without overlap.

    Raises:
        ConfigError: the rectangles overlap, leave a gap, exceed `bounds` or are empty; the message
            names the zones and the place.
    """

    bounds: Bounds  # the box that is divided; its sides are the rim
    # (k, 4) min_x, min_y, max_x, max_y in metres, read-only; together they tile `bounds`
    rects: NDArray[np.float64]

    def __post_init__(self) -> None:
        rects = np.array(self.rects, dtype=np.float64).reshape(-1, 4) + 0.0  # avoids -0.0 in hashes
        rects.setflags(write=False)
        object.__setattr__(self, "rects", rects)
        _check_rects(rects, self.bounds)
        self._cells  # noqa: B018 - finds overlaps and gaps

    @property
    def count(self) -> int:
        return len(self.rects)

    @cached_property
    def reaching(self) -> NDArray[np.float64]:
        """`rects` with the rim at infinity, (k, 4), read-only."""
        rim = np.array(self.bounds)
        endless = np.array([-np.inf, -np.inf, np.inf, np.inf])
        reaching = np.where(self.rects == rim, endless, self.rects)
        reaching.setflags(write=False)
        return reaching

    @cached_property
    def arrays(self) -> ZoneArrays:
        return ZoneArrays(
            self._sides(0)[1:-1].copy(), self._sides(1)[1:-1].copy(), self._cells, self.reaching
        )

    def zones_of(self, xy: NDArray[np.float64]) -> NDArray[np.int32]:
        """Return the zones (n,) of positions (n, 2) in metres."""
        places = np.ascontiguousarray(xy, dtype=np.float64).reshape(-1, 2).view(_PLACE)[:, 0]
        zones = np.empty(len(places), np.int32)
        zones_of(self.arrays, places, len(places), zones)
        return zones

    @cached_property
    def neighbors(self) -> tuple[tuple[Neighbor, ...], ...]:
        """The zones that touch each zone, by number, including zones that share only a corner."""
        low, high = self.rects[:, None, :2], self.rects[None, :, 2:]
        # Overlap of two rectangles on each axis: below 0 they are apart, at 0 they touch.
        shared = np.minimum(high, high.swapaxes(0, 1)) - np.maximum(low, low.swapaxes(0, 1))
        touching = (shared >= 0.0).all(axis=2) & ~np.eye(self.count, dtype=bool)
        corner = (shared == 0.0).all(axis=2)
        return tuple(
            tuple(Neighbor(int(b), bool(corner[a, b])) for b in np.flatnonzero(touching[a]))
            for a in range(self.count)
        )

    def within(self, distance_m: float) -> NDArray[np.bool_]:
        """Return (k, k) whether two zones are within a distance; each zone is near itself."""
        rects = self.reaching
        gaps = np.maximum(rects[:, None, :2] - rects[None, :, 2:], 0.0)
        gaps = np.maximum(gaps, gaps.swapaxes(0, 1))
        near: NDArray[np.bool_] = (gaps * gaps).sum(axis=2) <= distance_m * distance_m
        return near

    @property
    def side_neighbors(self) -> tuple[tuple[int, ...], ...]:
        """The zones that share a side with each zone. Vehicles hardly ever cross corners."""
        return tuple(tuple(near.zone for near in row if not near.corner) for row in self.neighbors)

    @cached_property
    def content_hash(self) -> str:
        """SHA-256, in hex, of the rectangles with the rim at infinity, for manifests."""
        sides = [[float(side).hex() for side in rect] for rect in self.reaching]
        return hashlib.sha256(json.dumps({"cavmarl.zones": sides}).encode()).hexdigest()

    def _sides(self, axis: int) -> NDArray[np.float64]:
        return np.unique(self.rects[:, [axis, axis + 2]])

    @cached_property
    def _cells(self) -> NDArray[np.int32]:
        """The zone of each cell between adjacent sides, (rows, columns)."""
        sides_x, sides_y = self._sides(0), self._sides(1)
        cells = np.full((len(sides_y) - 1, len(sides_x) - 1), -1, dtype=np.int32)
        for zone, (left, low, right, high) in enumerate(self.rects):
            columns = slice(*np.searchsorted(sides_x, (left, right)))
            part = cells[slice(*np.searchsorted(sides_y, (low, high))), columns]
            if (part >= 0).any():
                other = int(part[part >= 0][0])
                raise ConfigError(_overlap(other, zone, self.rects))
            part[:] = zone
        if (cells < 0).any():
            row, column = np.argwhere(cells < 0)[0]
            gap = (*sides_x[column : column + 2], *sides_y[row : row + 2])
            raise ConfigError(
                f"no zone covers {_span(*gap)}; extend a zone beside the gap, because zones must "
                "cover bounds_m"
            )
        cells.setflags(write=False)
        return cells


def _check_rects(rects: NDArray[np.float64], bounds: Bounds) -> None:
    """Raise ConfigError if rectangles are invalid or empty, or do not fit `bounds`."""
    if not len(rects):
        raise ConfigError("there are no zones; define at least one, which covers the map")
    for key, rect in (("bounds_m", np.array(bounds)), *enumerate(rects)):
        name = key if isinstance(key, str) else f"zone {key}"
        if not np.isfinite(rect).all():
            raise ConfigError(
                f"{name}: {rect.tolist()} must be finite numbers; sides on bounds_m extend to "
                "infinity by themselves"
            )
        if not (rect[:2] < rect[2:]).all():
            raise ConfigError(
                f"{name}: {rect.tolist()} is empty; use min_x, min_y, max_x, max_y in m, with the "
                "first two below the last two"
            )
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
    for zone in np.flatnonzero(
        (rects[:, :2] < low).any(axis=1) | (rects[:, 2:] > high).any(axis=1)
    ):
        raise ConfigError(
            f"zone {zone}: {rects[zone].tolist()} exceeds bounds_m = {list(bounds)}; make the zone "
            "smaller, or bounds_m larger"
        )
    for axis, side in enumerate(bounds):
        if side not in rects[:, axis]:
            edge = ("min_x", "min_y", "max_x", "max_y")[axis]
            raise ConfigError(
                f"no zone reaches {edge} = {side:g} of bounds_m; extend the zones there to this "
                "side"
            )


def _overlap(a: int, b: int, rects: NDArray[np.float64]) -> str:
    left, low = np.maximum(rects[a, :2], rects[b, :2])
    right, high = np.minimum(rects[a, 2:], rects[b, 2:])
    return f"zones {a} and {b} overlap in {_span(left, right, low, high)}; make one of them smaller"


def _span(left: float, right: float, low: float, high: float) -> str:
    return f"x {left:.10g} to {right:.10g}, y {low:.10g} to {high:.10g}"
