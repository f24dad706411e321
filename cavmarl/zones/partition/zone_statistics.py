"""Statistics of a partition: lanes, cut junctions, vehicles and ghosts of each zone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_partition import ZonePartition
from cavmarl.zones.partition.zone_survey import junction_boxes, lane_segments

Floats = NDArray[np.float64]


def imbalance(values: Sequence[float]) -> float:
    """Return maximum / mean of k values: 1 if all are equal (even 0), k if only one value is not 0.

    With one worker per zone, the slowest worker sets the pace: the imbalance is the ratio of its
    time to the time with a perfect division.
    """
    mean = sum(values) / len(values)
    return max(values) / mean if mean else 1.0


@dataclass(frozen=True)
class ZoneStatistics:
    """Statistics of a partition. Tuples have one value per zone, except `narrow`."""

    lane_km: tuple[float, ...]  # length of lanes outside of junctions
    junctions: int  # number of junctions with crossing or merging lanes
    junctions_cut: int  # number of these junctions in more than one zone
    cut_junctions: tuple[int, ...]  # number of cut junctions that are partly in the zone
    vehicles: tuple[int, ...]  # number of vehicles in the zone; zeros if no positions are given
    # upper bound: vehicles of other zones within the halo; zeros if no positions are given
    ghosts: tuple[int, ...]
    # zones with a side shorter than the halo; their results are exact, but most of their vehicles
    # are ghosts
    narrow: tuple[int, ...]

    @property
    def lane_imbalance(self) -> float:
        return imbalance(self.lane_km)

    @property
    def vehicle_imbalance(self) -> float:
        return imbalance(self.vehicles)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self) | {
            "lane_imbalance": self.lane_imbalance,
            "vehicle_imbalance": self.vehicle_imbalance,
        }


def zone_statistics(
    partition: ZonePartition,
    network: RoadNetwork,
    *,
    halo_m: float = 0.0,  # how far zones see beyond their borders
    positions: Floats | None = None,  # (n, 2) x and y of vehicles in m
) -> ZoneStatistics:
    places = np.empty((0, 2)) if positions is None else np.asarray(positions, dtype=np.float64)
    owners = partition.zones_of(places)
    boxes = junction_boxes(network)
    shares = [zones for zones in _zones_of_boxes(partition, boxes) if len(zones) > 1]
    sides = partition.reaching[:, 2:] - partition.reaching[:, :2]
    return ZoneStatistics(
        lane_km=tuple(_lane_km(partition, network).tolist()),
        junctions=len(boxes),
        junctions_cut=len(shares),
        cut_junctions=tuple(
            sum(zone in zones for zones in shares) for zone in range(partition.count)
        ),
        vehicles=tuple(np.bincount(owners, minlength=partition.count).tolist()),
        ghosts=tuple(
            int(((owners != zone) & _within(rect, places, halo_m)).sum())
            for zone, rect in enumerate(partition.reaching)
        ),
        narrow=tuple(np.flatnonzero(sides.min(axis=1) < halo_m).tolist()),
    )


def _within(rect: Floats, places: Floats, halo_m: float) -> NDArray[np.bool_]:
    """Return whether each place is within the halo of a rectangle."""
    away = np.maximum(np.maximum(rect[:2] - places, places - rect[2:]), 0.0)
    return np.asarray((away * away).sum(axis=1) <= halo_m * halo_m)


def _zones_of_boxes(partition: ZonePartition, boxes: Floats) -> list[NDArray[np.int32]]:
    """Return the zones that each of (n, 4) boxes overlaps."""
    zones = partition.arrays
    columns = np.searchsorted(zones.cuts_x, boxes[:, [0, 2]], side="right")
    rows = np.searchsorted(zones.cuts_y, boxes[:, [1, 3]], side="right")
    return [
        np.unique(zones.cells[row[0] : row[1] + 1, column[0] : column[1] + 1])
        for row, column in zip(rows, columns, strict=True)
    ]


def _lane_km(partition: ZonePartition, network: RoadNetwork) -> Floats:
    """Return the length of lanes outside of junctions in each zone, in km."""
    segments = lane_segments(network)
    starts, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    cuts = [
        _crossings(starts[:, axis], along[:, axis], lines)
        for axis, lines in enumerate((partition.arrays.cuts_x, partition.arrays.cuts_y))
    ]
    ends = np.broadcast_to([0.0, 1.0], (len(segments), 2))
    shares = np.sort(np.concatenate([ends, *cuts], axis=1), axis=1)
    pieces = np.diff(shares, axis=1)
    middles = shares[:, :-1] + pieces / 2.0
    lengths = pieces * hypot_all(*along.T)[:, None]
    kept = lengths > 0.0
    which = np.nonzero(kept)[0]
    owners = partition.zones_of(starts[which] + middles[kept][:, None] * along[which])
    return np.bincount(owners, weights=lengths[kept], minlength=partition.count) / 1e3


def _crossings(starts: Floats, along: Floats, lines: Floats) -> Floats:
    """Return where segments meet lines, (n, lines): from 0 at the start to 1 at the end."""
    steps = np.where(along == 0.0, 1.0, along)[:, None]
    met = (lines[None, :] - starts[:, None]) / steps
    return np.where((along == 0.0)[:, None], 0.0, np.clip(met, 0.0, 1.0))
