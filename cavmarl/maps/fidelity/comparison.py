"""The comparison of two clouds: ICP's RMSE, mean distances in both directions, and a report.

Equations (1) and (2) and Table I are from the paper on the hybrid digital twin in
`docs/reference/map_fidelity.md`: RMSE = sqrt(mean |T(p) - q|²) over nearest pairs, and the mean
distance from each p to the cloud Q, which is not symmetric.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.maps.fidelity.cloud_files import Cloud
from cavmarl.maps.fidelity.cloud_registration import (
    Alignment,
    Target,
    align,
    moved,
    nearest_distances,
)

Points = NDArray[np.float64]

# Published values for another site and other clouds, for orientation only.
PAPER_TABLE = {
    "paper, mesh": {"icp_rmse_m": 0.635, "mean_distance_m": 0.183},
    "paper, CARLA map": {"icp_rmse_m": 1.831, "mean_distance_m": 1.077},
}
HISTOGRAM_M = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 5.0, 10.0, np.inf)


@dataclass(frozen=True)
class Comparison:
    """A cloud P that was compared with another cloud Q, usually after an alignment."""

    source: Cloud  # P, filtered, in its own frame
    reference: Cloud  # Q, filtered
    before_m: float  # mean distance P → Q before the alignment
    alignment: Alignment | None  # None: compared without alignment
    distance_m: Points  # (n,) distance of each point of P to its nearest point of Q
    reverse_m: Points  # distance of each point of Q to its nearest point of P
    transform: Points  # (4, 4) transform of P: `start`, then the alignment

    @property
    def aligned(self) -> Points:
        """P after the transform, (n, 3)."""
        return moved(self.source.points, self.transform)

    @property
    def rmse_m(self) -> float:
        return float(np.sqrt(np.mean(self.distance_m**2)))

    @property
    def mean_m(self) -> float:
        return float(self.distance_m.mean())

    def to_dict(self) -> dict[str, Any]:
        found = self.alignment
        return {
            "from": {"name": self.source.name, "counts": self.source.counts},
            "to": {"name": self.reference.name, "counts": self.reference.counts},
            "converged": None if found is None else found.converged,
            "problems": [] if found is None else list(found.problems),
            "transform": self.transform.tolist(),
            "yaw_deg": None if found is None else found.yaw_deg,
            "trimmed_rmse_m": None if found is None else found.trimmed_rmse_m,
            "icp_rmse_m": self.rmse_m,
            "mean_distance_before_m": self.before_m,
            "mean_distance_m": self.mean_m,
            "mean_distance_reverse_m": float(self.reverse_m.mean()),
            "mean_distance_symmetric_m": 0.5 * (self.mean_m + float(self.reverse_m.mean())),
            "median_distance_m": float(np.median(self.distance_m)),
            "p95_distance_m": float(np.quantile(self.distance_m, 0.95)),
            "largest_distance_m": float(self.distance_m.max()),
            "histogram": histogram(self.distance_m),
        }


def compare(
    source: Cloud,
    reference: Cloud,
    *,
    start: Points | None = None,
    keep: float = 0.8,
    registered: bool = True,
    threads: int = 2,
) -> Comparison:
    """Align P (`source`) with Q (`reference`), if `registered`, and measure both distances.

    `start`: (4, 4) approximate transform of P. `keep`: see `align`.
    """
    target = Target(reference.points, threads)
    begin = np.eye(4) if start is None else start
    placed = moved(source.points, begin)
    alignment = align(placed, target, keep=keep) if registered else None
    if alignment is None:
        transform, (_, before_m) = begin, target.nearest(placed)
        distance_m = before_m
    else:
        transform, before_m = alignment.transform @ begin, alignment.before_m
        distance_m = alignment.distance_m
    reverse_m = nearest_distances(reference.points, moved(source.points, transform), threads)
    return Comparison(
        source, reference, float(before_m.mean()), alignment, distance_m, reverse_m, transform
    )


def histogram(distance_m: Points) -> list[dict[str, float | int | None]]:
    """Return the number of points in each interval of distances in m."""
    counts, _ = np.histogram(distance_m, bins=np.array(HISTOGRAM_M))
    return [
        {"from_m": low, "to_m": None if np.isinf(high) else high, "points": int(count)}
        for low, high, count in zip(HISTOGRAM_M[:-1], HISTOGRAM_M[1:], counts, strict=True)
    ]


def start_transform(text: str | None) -> Points:
    """Return the transform (4, 4) of "x,y,z,yaw" in m and degrees."""
    motion = np.eye(4)
    if text is None:
        return motion
    try:
        x, y, z, yaw_deg = map(float, text.split(","))
    except ValueError as error:
        raise ConfigError(
            f"--start {text}: must be four numbers x,y,z,yaw, in m and degrees"
        ) from error
    if not np.isfinite([x, y, z, yaw_deg]).all():
        raise ConfigError(f"--start {text}: must be finite")
    yaw = np.radians(yaw_deg)
    motion[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    motion[:3, 3] = x, y, z
    return motion
