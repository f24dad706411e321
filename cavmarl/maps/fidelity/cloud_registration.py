"""Registration of two clouds: trimmed ICP with small_gicp, and its reliability."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, MapError, require

Points = NDArray[np.float64]

FEWEST_POINTS = 50
_NORMAL_NEIGHBOURS = 20
STAGES = 12
_SETTLED_M, _SETTLED_RAD = 1e-4, 1e-6
_ITERATIONS = 50
_WIDEST_M = 10.0  # points farther from the other cloud have no corresponding point
# If the share of normals along a direction is smaller, the cloud can slide in this direction.
_HELD = 0.005
# An alignment is good if the kept points are about as near to the other cloud as to each other.
_SPACINGS, _LEAST_LIMIT_M, _MOST_LIMIT_M = 2.5, 0.1, 0.5
_SAMPLE = 10_000  # number of points from which the spacing is computed


@dataclass(frozen=True)
class Alignment:
    """The rigid motion that aligns a source with a target, and its quality."""

    transform: Points  # (4, 4), from the source's frame to the target's
    trimmed_rmse_m: float  # over the kept share of the points
    limit_m: float  # limit of `trimmed_rmse_m`
    stages: int
    problems: tuple[str, ...]  # reasons why it is not reliable; empty if it is
    before_m: Points  # (n,) distance of each point of the source to the target before the motion
    distance_m: Points  # (n,) the same after the motion

    @property
    def converged(self) -> bool:
        return not self.problems

    @property
    def yaw_deg(self) -> float:
        return float(np.degrees(np.arctan2(self.transform[1, 0], self.transform[0, 0])))


def moved(points: Points, transform: Points) -> Points:
    """Return points (n, 3) transformed by a motion (4, 4)."""
    found: Points = points @ transform[:3, :3].T + transform[:3, 3]
    return found


def nearest_distances(points: Points, others: Points, threads: int = 2) -> Points:
    """Return distances (n,) in m of points (n, 3) to the nearest of others (m, 3)."""
    gicp: Any = require("small_gicp", "maps")
    middle = others.mean(axis=0)
    tree = gicp.KdTree(others - middle, threads)
    found: Points = np.sqrt(
        np.asarray(tree.batch_nearest_neighbor_search(points - middle, threads)[1])
    )
    return found


class Target:
    """A cloud for registration, with its search tree; centred at its mean for precision."""

    def __init__(self, points: Points, threads: int = 2) -> None:
        gicp: Any = require("small_gicp", "maps")
        if len(points) < FEWEST_POINTS:
            raise MapError(
                f"a cloud has {len(points)} points; at least {FEWEST_POINTS} are needed: use "
                "smaller voxels, or another cloud"
            )
        self.middle_m = points.mean(axis=0)
        self.points = points - self.middle_m
        self.threads = threads
        self.cloud = gicp.PointCloud(self.points)
        self.tree = gicp.KdTree(self.cloud, threads)
        gicp.estimate_normals_covariances(self.cloud, self.tree, _NORMAL_NEIGHBOURS, threads)

    @property
    def spacing_m(self) -> float:
        """The median distance of a point to its nearest neighbour."""
        sample = self.points[:: -(-len(self.points) // _SAMPLE)]
        _, squares = self.tree.batch_knn_search(sample, 2, self.threads)
        return float(np.sqrt(np.median(np.asarray(squares)[:, 1])))

    def nearest(self, points: Points) -> tuple[NDArray[np.int64], Points]:
        """Return the row of the point nearest to each of (n, 3) positions, and distances in m."""
        rows, squares = self.tree.batch_nearest_neighbor_search(
            points - self.middle_m, self.threads
        )
        return np.asarray(rows), np.sqrt(np.asarray(squares))


def align(source: Points, target: Target, *, keep: float = 0.8) -> Alignment:
    """Align a source with a target by ICP, using only a share of the nearest pairs.

    Each stage ignores pairs farther apart than twice the `keep` quantile of distances (Chetverikov
    et al., "The trimmed iterative closest point algorithm", 2002). Within a stage, small_gicp
    minimises distances between surfaces (generalized ICP).

    Raises:
        ConfigError: `keep` is not a valid share.
        MapError: there are too few points.
    """
    gicp: Any = require("small_gicp", "maps")
    if not 0.1 <= keep <= 1.0:
        raise ConfigError(f"keep {keep:g}: must be a share from 0.1 to 1 of the points")
    own = Target(source, target.threads)
    motion, last_m = np.eye(4), np.inf
    motion[:3, 3] = own.middle_m - target.middle_m
    rows, before_m = target.nearest(source)
    distance_m = before_m
    gate_m = min(max(2.0 * float(np.quantile(before_m, 0.95)), 1.0), _WIDEST_M)
    stages = 0
    while stages < STAGES:
        stages += 1
        found = gicp.align(
            target.cloud,
            own.cloud,
            target.tree,
            motion,
            max_correspondence_distance=gate_m,
            num_threads=target.threads,
            max_iterations=_ITERATIONS,
            rotation_epsilon=_SETTLED_RAD,
            translation_epsilon=0.1 * _SETTLED_M,
        )
        step = np.linalg.inv(motion) @ found.T_target_source
        last_m = _size_m(step, own.points)
        motion = np.asarray(found.T_target_source)
        rows, distance_m = target.nearest(moved(own.points, motion) + target.middle_m)
        narrower_m = min(gate_m, max(2.0 * float(np.quantile(distance_m, keep)), 1e-3))
        if last_m < _SETTLED_M and narrower_m > 0.95 * gate_m:
            break
        gate_m = narrower_m
    problems, rmse_m, limit_m = _assess(own, target, rows, distance_m, keep, stages, last_m)
    absolute = motion.copy()
    absolute[:3, 3] += target.middle_m - motion[:3, :3] @ own.middle_m
    return Alignment(absolute, rmse_m, limit_m, stages, problems, before_m, distance_m)


def _size_m(step: Points, points: Points) -> float:
    """Return the largest displacement of the corners of a cloud by a motion."""
    corners = np.stack([points.min(axis=0), points.max(axis=0)])
    return float(np.linalg.norm(moved(corners, step) - corners, axis=1).max())


def _assess(
    own: Target,
    target: Target,
    rows: NDArray[np.int64],
    distance_m: Points,
    keep: float,
    stages: int,
    last_m: float,
) -> tuple[tuple[str, ...], float, float]:
    """Return the problems of an alignment, the RMSE of the kept pairs, and its limit."""
    order = np.argsort(distance_m, kind="stable")[: max(int(keep * len(distance_m)), 1)]
    rmse_m = float(np.sqrt(np.mean(distance_m[order] ** 2)))
    spacing_m = max(own.spacing_m, target.spacing_m)
    limit_m = float(np.clip(_SPACINGS * spacing_m, _LEAST_LIMIT_M, _MOST_LIMIT_M))
    problems = []
    if last_m > 10.0 * _SETTLED_M:
        problems.append(f"the last stage ({stages}) still moved it by {1e3 * last_m:.1f} mm")
    if rmse_m > limit_m:
        problems.append(
            f"the nearest {keep:.0%} of the points have an RMSE of {rmse_m:.3f} m, more than "
            f"{limit_m:.3f} m: the clouds show different places, or start too far apart (--start)"
        )
    normals = np.asarray(target.cloud.normals())[rows[order], :3]
    share, axes = np.linalg.eigh(normals.T @ normals / len(normals))
    if share[0] < _HELD:
        along = ", ".join(f"{value:.2f}" for value in axes[:, 0])
        problems.append(
            f"the cloud can slide along ({along}), because few surfaces face this direction: give "
            "walls (--buildings), or a cloud that is more than a plane"
        )
    return tuple(problems), rmse_m, limit_m
