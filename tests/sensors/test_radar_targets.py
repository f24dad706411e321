from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.roads.kernels.backdrop_pieces import WALL
from cavmarl.sensors.kernels.ray_caster import HIT, cast, make_fan
from cavmarl.sensors.kernels.rig_rays import TARGET, detect
from tests.naive import imaging as naive
from tests.support.builders import crowds, vehicles
from tests.support.imaging import NO_WALLS, backdrop, look_around, mount, mounts, wall_sets

Floats = NDArray[np.float64]
AZIMUTHS = (-0.5, 0.05, 21)


def echoes(
    rows: NDArray[np.void], matrix: Floats, walls: NDArray[np.void] = NO_WALLS, row: int = 0
) -> NDArray[np.void]:
    """Return the records TARGET, sorted by distance."""
    fan = make_fan(matrix, AZIMUTHS, np.zeros(1), 60.0)
    panorama, counts = look_around(rows, row, backdrop(walls), 65.0)
    hits = np.zeros((AZIMUTHS[2], 1), HIT)
    cast(fan, panorama.prisms, counts.prisms, panorama.walls, counts.walls, 0, len(hits), hits)
    targets = np.zeros(AZIMUTHS[2], TARGET)
    order = np.zeros(AZIMUTHS[2], np.int32)
    found = detect(fan, panorama, rows[row], hits, targets, order)
    return targets[order[:found]]


@given(crowds(most=6), wall_sets(), mounts())
def test_targets_equal_twin(
    rows: NDArray[np.void], walls: NDArray[np.void], matrix: Floats
) -> None:
    first, step, count = AZIMUTHS
    rays = naive.fan_rays(matrix[:, :3], first + step * np.arange(count), np.zeros(1))[:, 0]
    nearest: dict[tuple[str, int], float] = {}
    unsure: set[tuple[str, int]] = set()
    for ray in rays:
        large, small = (
            naive.trace(rows, 0, walls, matrix[:, 3], ray, 60.0, margin) for margin in (1e-6, -1e-6)
        )
        if large.what != small.what or abs(large.distance - small.distance) > 1e-3:
            unsure |= {large.what, small.what}
        if large.what[0] == "wall":  # another body or wall may be equally near
            others = walls[walls["building"] != large.what[1]]
            other = naive.trace(rows, 0, others, matrix[:, 3], ray, 60.0)
            if other.distance - large.distance < 1e-3:
                unsure |= {large.what, other.what}
        if large.what[0] in ("body", "wall"):
            nearest[large.what] = min(large.distance, nearest.get(large.what, math.inf))
    kinds = {1: "body", 0: "wall"}
    found = {(kinds[t["body"]], int(t["id"])): t["range"] for t in echoes(rows, matrix, walls)}
    for what in (nearest.keys() | found.keys()) - unsure:
        assert found[what] == pytest.approx(nearest[what], abs=2e-3)
    ranges = [target["range"] for target in echoes(rows, matrix, walls)]
    assert ranges == sorted(ranges)


def test_targets_are_sorted_by_distance_for_any_order_of_rows() -> None:
    places = [(0.0, 0.0, 0.0), (40.0, -12.0, 0.0), (20.0, 0.0, 0.0), (30.0, 9.0, 0.0)]
    for order in ([0, 1, 2, 3], [0, 3, 1, 2], [0, 2, 3, 1]):
        rows = vehicles([places[k] for k in order])
        ranges = [target["range"] for target in echoes(rows, mount((0.0, 0.0, 0.5)))]
        assert len(ranges) == 3
        assert ranges == sorted(ranges)


def test_a_wall_of_two_parts_is_one_target() -> None:
    walls = np.array([(10.0, -20.0, 10.0, 0.0, 8.0, 7), (10.0, 0.0, 10.0, 20.0, 8.0, 7)], WALL)
    (target,) = echoes(vehicles([(0.0, 0.0, 0.0)], speed=3.0), mount((0.0, 0.0, 0.5)), walls)
    assert target["range"] == pytest.approx(10.0)
    assert target["azimuth"] == pytest.approx(0.0)
    assert target["speed"] == pytest.approx(-3.0)
    assert (target["body"], target["id"]) == (0, 7)


@pytest.mark.parametrize("azimuth", [-0.45, -0.2, 0.3, 0.5])
def test_the_nearest_echo_may_come_from_any_ray(azimuth: float) -> None:
    """A corner of a body points to the sensor, and several rays hit the sides of the body."""
    x, y = 20.0 * math.cos(azimuth), 20.0 * math.sin(azimuth)
    rows = vehicles(
        [(0.0, 0.0, 0.0), (x, y, azimuth + 0.25 * math.pi)], length=4.0, width=4.0, speed=[3.0, 7.0]
    )
    (target,) = echoes(rows, mount((0.0, 0.0, 0.5)))
    assert target["azimuth"] == pytest.approx(azimuth)
    assert target["range"] == pytest.approx(20.0 - math.sqrt(8.0))
    own = 3.0 * math.cos(azimuth)
    assert target["speed"] == pytest.approx(7.0 * math.cos(0.25 * math.pi) - own)


def test_a_sensor_at_the_end_of_a_wall_is_inside_the_wall() -> None:
    walls = np.array([(0.0, 0.0, 0.0, 1.0, 8.0, 3), (10.0, -20.0, 10.0, 20.0, 8.0, 7)], WALL)
    targets = echoes(vehicles([(0.0, 0.0, 0.0)], speed=0.0), mount((0.0, 0.0, 0.5)), walls)
    assert [(target["id"], target["range"]) for target in targets] == [(3, 0.0)]


def test_radial_speeds_are_relative_and_positive_for_targets_that_move_away() -> None:
    rows = vehicles(
        [(0.0, 0.0, 0.0), (20.0, 0.0, 0.0), (20.0, 8.0, math.pi)], speed=[10.0, 14.0, 5.0]
    )
    ahead, coming = sorted(echoes(rows, mount((0.0, 0.0, 0.5))), key=lambda t: t["id"])
    assert ahead["range"] == pytest.approx(17.5)
    assert ahead["speed"] == pytest.approx(4.0)
    assert coming["speed"] == pytest.approx(-15.0 * math.cos(coming["azimuth"]))


@given(st.floats(-1.0, 1.0), st.floats(-2.0, 2.0), st.floats(-1.0, 1.0), st.floats(-0.5, 0.5))
def test_radial_speeds_include_the_rotation_of_the_ego_vehicle(
    yaw_rate: float, x: float, y: float, normal: float
) -> None:
    """The nearest point of a long wall lies in the direction of its normal."""
    cos, sin = math.cos(normal), math.sin(normal)
    ends = [(30.0 * cos - side * sin, 30.0 * sin + side * cos) for side in (-90.0, 90.0)]
    wall = np.array([(*ends[0], *ends[1], 8.0, 0)], WALL)
    rows = vehicles([(0.0, 0.0, 0.0)], speed=10.0, yaw_rate=yaw_rate)
    (target,) = echoes(rows, mount((x, y, 0.5)), wall)
    azimuth = target["azimuth"]
    assert abs(azimuth - normal) <= 0.5 * AZIMUTHS[1] + 1e-9
    away = 30.0 - x * cos - y * sin
    assert target["range"] == pytest.approx(away / math.cos(azimuth - normal))
    velocity = (10.0 - yaw_rate * y, yaw_rate * x)
    assert target["speed"] == pytest.approx(
        -(velocity[0] * math.cos(azimuth) + velocity[1] * math.sin(azimuth))
    )


def test_hidden_bodies_give_no_echo() -> None:
    rows = vehicles([(0.0, 0.0, 0.0), (10.0, 0.0, 0.5 * math.pi), (30.0, 0.0, 0.0)], length=12.0)
    assert echoes(rows, mount((0.0, 0.0, 0.5)))["id"].tolist() == [1]
    assert echoes(rows[[0, 2]], mount((0.0, 0.0, 0.5)))["id"].tolist() == [2]
