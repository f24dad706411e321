"""The realism meta-metric equals an independent computation; the log itself is realistic."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import ScenarioError
from cavmarl.evaluate.realism.realism_metric import COMPONENTS, realism_of
from cavmarl.evaluate.realism.rollout_features import Trajectories, features_of
from tests.naive.realism import (
    WEIGHTS,
    Body,
    corners,
    edge_distance,
    likelihoods,
    object_distance,
)
from tests.support.logged_scenes import edge_lines

STEP_S = 0.1
EDGES = [*edge_lines(), np.array([(9.0, 9.0), (5.0, 9.0), (5.0, 5.0), (9.0, 5.0), (9.0, 8.9)])]
LINES = [[(float(x), float(y)) for x, y in line] for line in EDGES]
Random = np.random.Generator


def scene(random: Random, objects: int, times: int) -> Trajectories:
    """Return objects with noisy paths, near each other and near road edges."""
    heading = random.uniform(-math.pi, math.pi, (objects, 1))
    heading = heading + np.cumsum(random.normal(0.0, 0.02, (objects, times)), axis=1)
    heading = (heading + math.pi) % (2.0 * math.pi) - math.pi
    speed = random.uniform(0.0, 15.0, (objects, 1)) + random.normal(0.0, 0.3, (objects, times))
    x = random.uniform(-25.0, 25.0, (objects, 1)) + np.cumsum(
        speed * np.cos(heading) * STEP_S, axis=1
    )
    y = random.uniform(-25.0, 25.0, (objects, 1)) + np.cumsum(
        speed * np.sin(heading) * STEP_S, axis=1
    )
    sizes = np.stack([random.uniform(1.0, 9.0, objects), random.uniform(0.5, 2.5, objects)], axis=1)
    valid = np.ones((objects, times), dtype=np.bool_)
    valid[-1, times // 2 :] = False
    valid[0, 3:5] = False
    return Trajectories(np.stack([x, y, heading], axis=2), valid, sizes)


def followers(random: Random, times: int) -> Trajectories:
    """Return vehicles in a row that approach each other, so that times to collision are short."""
    speeds = np.array([[12.0], [9.0], [8.0], [4.0]]) + random.normal(0.0, 0.1, (4, times))
    x = np.array([[-40.0], [-28.0], [-18.0], [-5.0]]) + np.cumsum(speeds * STEP_S, axis=1)
    y = np.array([[0.0], [0.3], [-1.4], [0.2]]) + random.normal(0.0, 0.02, (4, times))
    heading = np.array([[0.0], [0.1], [0.0], [0.3]]) + random.normal(0.0, 0.01, (4, times))
    sizes = np.tile([4.5, 1.9], (4, 1))
    return Trajectories(np.stack([x, y, heading], axis=2), np.ones((4, times), np.bool_), sizes)


def bodies(objects: Trajectories) -> list[Body]:
    return [
        Body(
            [tuple(pose) if there else None for pose, there in zip(poses, valid, strict=True)],
            *size,
        )
        for poses, valid, size in zip(
            objects.poses.tolist(), objects.valid.tolist(), objects.sizes_m.tolist(), strict=True
        )
    ]


def noisy(objects: Trajectories, random: Random, first: int) -> Trajectories:
    """Return a rollout: the log before sample `first`, and the log with noise from there on."""
    poses = objects.poses.copy()
    poses[:, first:] += random.normal(0.0, 0.3, poses[:, first:].shape) * (1.0, 1.0, 0.1)
    poses[..., 2] = (poses[..., 2] + math.pi) % (2.0 * math.pi) - math.pi
    valid = objects.valid.copy()
    valid[:, first:] = random.random(valid[:, first:].shape) < 0.95
    return Trajectories(poses, valid, objects.sizes_m)


def compared(
    log: Trajectories, rollouts: list[Trajectories], evaluated: int, first: int
) -> dict[str, float]:
    features = [features_of(one, evaluated, EDGES, STEP_S) for one in (log, *rollouts)]
    found = realism_of(features[0], features[1:], first)
    return {**found.likelihoods, "meta": found.meta}


@pytest.mark.parametrize("seed", range(5))
def test_all_components_equal_an_independent_computation(seed: int) -> None:
    random = np.random.default_rng(seed)
    log = followers(random, 24) if seed == 4 else scene(random, 5, 24)
    evaluated, first = 3, 6
    rollouts = [noisy(log, random, first) for _ in range(4)]
    found = compared(log, rollouts, evaluated, first)
    wanted = likelihoods(
        bodies(log), [bodies(one) for one in rollouts], evaluated, LINES, STEP_S, first
    )
    assert found == pytest.approx(wanted, rel=1e-9)


def test_the_weights_equal_those_of_the_challenge_of_2024() -> None:
    assert {name: one.weight for name, one in COMPONENTS.items()} == WEIGHTS
    assert sum(WEIGHTS.values()) == pytest.approx(1.0)


def test_rollouts_equal_to_the_log_are_more_realistic_than_standing_vehicles() -> None:
    log = followers(np.random.default_rng(0), 40)
    first = 6
    standing = Trajectories(log.poses.copy(), log.valid, log.sizes_m)
    standing.poses[:, first:] = log.poses[:, first - 1 : first]
    same, still = (compared(log, [one] * 8, 2, first) for one in (log, standing))
    assert same["meta"] > 0.75
    assert same["linear_speed"] > 0.5 > 0.01 > still["linear_speed"]
    assert still["meta"] < same["meta"] - 0.05


def random_boxes(random: Random, count: int) -> tuple[NDArray[Any], NDArray[Any]]:
    poses = random.uniform(-6.0, 6.0, (count, 1, 3))
    return poses, random.uniform(0.5, 8.0, (count, 2))


def test_distances_of_bodies_equal_those_of_minkowski_differences() -> None:
    random = np.random.default_rng(1)
    negative = 0
    for _ in range(300):
        poses, sizes = random_boxes(random, 2)
        objects = Trajectories(poses, np.ones((2, 1), np.bool_), sizes)
        found = features_of(objects, 1, EDGES, STEP_S).distance_to_nearest_object[0, 0]
        boxes = [(tuple(poses[k, 0]), *sizes[k]) for k in (0, 1)]
        assert found == pytest.approx(object_distance(*boxes), abs=1e-9)
        negative += found < 0.0
    assert 30 < negative < 270


def test_objects_have_round_corners() -> None:
    """Two squares touch or overlap at a corner, where rounded objects are apart."""
    apart = 0.7 * 2.0 * (math.sqrt(2.0) - 1.0)  # both corners have a radius of 0.7 m
    for shift, expected in ((2.0, apart), (1.9, apart - 0.1 * math.sqrt(2.0))):
        poses = np.array([[[0.0, 0.0, 0.0]], [[shift, shift, 0.0]]])
        objects = Trajectories(poses, np.ones((2, 1), np.bool_), np.full((2, 2), 2.0))
        found = features_of(objects, 2, EDGES, STEP_S)
        assert found.distance_to_nearest_object == pytest.approx(expected)
        assert not found.collided.any()


def test_distances_to_road_edges_are_negative_on_the_road() -> None:
    random = np.random.default_rng(2)
    poses, sizes = random_boxes(random, 300)
    objects = Trajectories(2.0 * poses, np.ones((300, 1), np.bool_), sizes)
    found = features_of(objects, 300, EDGES, STEP_S).distance_to_road_edge[:, 0]
    for k in range(300):
        box = corners(tuple(objects.poses[k, 0]), *sizes[k])
        assert found[k] == pytest.approx(max(edge_distance(one, LINES) for one in box), abs=1e-9)
    line = [np.array([(0.0, 0.0), (10.0, 0.0)])]
    for y, expected in ((3.0, -2.0), (-3.0, 4.0)):  # the road is to the left of its edge
        one = Trajectories(np.array([[[5.0, y, 0.0]]]), np.ones((1, 1), np.bool_),
                           np.array([[4.0, 2.0]]))  # fmt: skip
        assert features_of(one, 1, line, STEP_S).distance_to_road_edge[0, 0] == expected


def test_a_scene_without_road_edges_or_with_a_short_log_is_refused() -> None:
    log = followers(np.random.default_rng(0), 12)
    with pytest.raises(ScenarioError, match="no road edges"):
        features_of(log, 2, [], STEP_S)
    features = features_of(log, 2, EDGES, STEP_S)
    with pytest.raises(ScenarioError, match="five consecutive samples"):
        realism_of(features, [features], 11)
