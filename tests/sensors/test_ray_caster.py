from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.roads.kernels.backdrop_pieces import WALL
from cavmarl.sensors.kernels.ray_caster import HIT, WALL_HIT, Fan, cast, make_fan
from tests.naive import imaging as naive
from tests.support.builders import crowds, vehicles
from tests.support.imaging import NO_WALLS, backdrop, look_around, mount, mounts, wall_sets

Floats = NDArray[np.float64]
LEVEL = np.zeros(1)


def scan(
    rows: NDArray[np.void], fan: Fan, row: int = 0, walls: NDArray[np.void] = NO_WALLS
) -> NDArray[np.void]:
    """Return HIT (azimuths, elevations) of all rays of a fan."""
    panorama, counts = look_around(rows, row, backdrop(walls), fan.range_m + 3.0)
    hits = np.zeros(fan.rays.shape[:2], HIT)
    cast(fan, panorama.prisms, counts.prisms, panorama.walls, counts.walls, 0, len(hits), hits)
    return hits


def full_circle(matrix: Floats, rays: int = 8, range_m: float = 60.0) -> Fan:
    return make_fan(matrix, (0.0, 2.0 * math.pi / rays, rays), LEVEL, range_m)


AZIMUTHS = st.sampled_from(
    [(0.0, 2.0 * math.pi / 7, 7), (-0.5, 0.2, 6), (-math.pi, 2.0 * math.pi / 16, 16), (2.5, 0.3, 9)]
)


@given(crowds(most=6), wall_sets(), mounts(), st.integers(1, 16))
def test_the_hit_of_a_ray_does_not_depend_on_its_batch(
    rows: NDArray[np.void], walls: NDArray[np.void], matrix: Floats, columns: int
) -> None:
    fan = make_fan(matrix, (0.3, math.pi / 8, 16), np.array([-0.2, 0.1]), 60.0)
    panorama, counts = look_around(rows, 0, backdrop(walls), fan.range_m + 3.0)
    bodies = panorama.prisms, counts.prisms, panorama.walls, counts.walls
    whole, parts = np.zeros((2, 16, 2), HIT)
    cast(fan, *bodies, 0, 16, whole)
    for first in range(0, 16, columns):
        cast(fan, *bodies, first, min(first + columns, 16), parts)
    assert (parts == whole).all()


def begins_on_a_wall(walls: NDArray[np.void], start: Floats) -> bool:
    """Return whether a point of the world is on a wall, including its ends and its top."""
    along = np.array([walls["bx"] - walls["ax"], walls["by"] - walls["ay"]])
    before = np.array([start[0] - walls["ax"], start[1] - walls["ay"]])
    share = ((along * before).sum(axis=0) / (along * along).sum(axis=0)).clip(0.0, 1.0)
    apart = np.hypot(*(before - share * along)) <= 1e-6
    return bool((apart & (start[2] <= walls["height"] + 1e-6)).any())


def runs_within_a_wall(walls: NDArray[np.void], start: Floats, ray: Floats) -> bool:
    """Return whether a ray starts on the line of a wall and is parallel to the wall."""
    along = np.array([walls["bx"] - walls["ax"], walls["by"] - walls["ay"]])
    before = np.array([start[0] - walls["ax"], start[1] - walls["ay"]])
    least = 1e-6 * np.hypot(*along)
    begins = np.abs(along[0] * before[1] - along[1] * before[0]) <= least
    parallel = np.abs(along[0] * ray[1] - along[1] * ray[0]) <= least
    return bool((begins & parallel).any())


@given(
    crowds(most=6), wall_sets(), mounts(), AZIMUTHS,
    st.sampled_from([(0.0,), (-0.4, -0.1, 0.2)]), st.sampled_from([5.0, 60.0]),
    st.sampled_from([0.0, 0.1]),
)  # fmt: skip
def test_rays_equal_twin(
    rows: NDArray[np.void],
    walls: NDArray[np.void],
    matrix: Floats,
    azimuths: tuple[float, float, int],
    elevations: tuple[float, ...],
    range_m: float,
    pitch: float,
) -> None:
    rows["pitch"][0] = pitch
    first, step, count = azimuths
    fan = make_fan(matrix, azimuths, np.array(elevations), range_m)
    hits = scan(rows, fan, 0, walls)
    turns = first + step * np.arange(count)
    rays = naive.fan_rays(matrix[:, :3], turns, np.array(elevations))
    start = matrix[:, 3]
    axes = naive.turn(rows["heading"][0], 0.0, 0.0)
    place = axes @ start + np.array([rows["x"][0], rows["y"][0], 0.0])
    # Skip sensors on a wall, because rounding decides whether the wall is ahead of a ray.
    assume(not begins_on_a_wall(walls, place))
    for a, e in np.ndindex(*hits.shape):
        hit = hits[a, e]
        if runs_within_a_wall(walls, place, axes @ rays[a, e]):
            continue  # rounding decides whether and where the ray hits that wall
        # Rounding decides whether a ray along a side hits it, so compute with sizes 1 µm larger and
        # smaller.
        nearer, further = (
            naive.trace(rows, 0, walls, start, rays[a, e], range_m, margin)
            for margin in (1e-6, -1e-6)
        )
        same = nearer.what == further.what and abs(nearer.distance - further.distance) < 1e-3
        if same:
            assert hit["distance"] == pytest.approx(nearer.distance, abs=2e-3)
            assert (hit["id"] if hit["id"] >= 0 else -1) == (
                nearer.what[1] if nearer.what[0] == "body" else -1
            )
        else:
            known = (nearer.distance, further.distance, range_m)
            assert min(known) - 1e-3 <= hit["distance"] <= max(known) + 1e-3


@given(crowds(), mounts(), st.randoms(use_true_random=False))
def test_the_order_of_rows_does_not_matter(
    rows: NDArray[np.void], matrix: Floats, random: object
) -> None:
    order = list(range(len(rows)))
    random.shuffle(order)  # type: ignore[attr-defined]
    fan = make_fan(matrix, (0.0, math.pi / 8, 16), np.array([-0.2, 0.1]), 60.0)
    for place, row in enumerate(order):
        once, again = scan(rows, fan, row), scan(rows[order], fan, place)
        assert once["distance"].tobytes() == again["distance"].tobytes()
        assert once["id"].tobytes() == again["id"].tobytes()


def test_rays_measure_10_m_to_a_wall_and_to_a_long_body_ten_metres_ahead() -> None:
    wall = np.array([(10.0, -20.0, 10.0, 20.0, 8.0, 0)], WALL)
    ego = vehicles([(0.0, 0.0, 0.0)])
    assert scan(ego, full_circle(mount()), walls=wall)["distance"][0, 0] == 10.0
    box = vehicles([(0.0, 0.0, 0.0), (11.0, 0.0, 0.5 * math.pi)], length=40.0)
    hits = scan(box, full_circle(mount()))
    assert hits["distance"][0, 0] == pytest.approx(10.0, abs=1e-12)
    assert hits["distance"][1, 0] == pytest.approx(10.0 * math.sqrt(2.0), abs=1e-12)


@pytest.mark.parametrize("yaw", [0.0, 0.5, 2.0, -2.5])
def test_the_first_ray_of_a_turned_sensor_points_along_its_yaw(yaw: float) -> None:
    target = (20.0 * math.cos(yaw), 20.0 * math.sin(yaw), yaw)
    hits = scan(vehicles([(0.0, 0.0, 0.0), target]), full_circle(mount(angles=(yaw, 0.0, 0.0))))
    assert hits["distance"][0, 0] == pytest.approx(17.5)
    assert hits["id"][0, 0] == 1


def test_a_sensor_that_looks_down_sees_the_ground() -> None:
    pitch = -math.radians(30.0)
    hits = scan(vehicles([(0.0, 0.0, 0.0)]), full_circle(mount((0, 0, 1.5), (0.0, pitch, 0.0))))
    assert hits["distance"][0, 0] == pytest.approx(3.0)
    assert hits["distance"][4, 0] == 60.0  # the backward rays look up


def test_a_rolled_sensor_sees_the_ground_on_its_lower_side() -> None:
    hits = scan(vehicles([(0.0, 0.0, 0.0)]), full_circle(mount((0, 0, 1.5), (0.0, 0.0, 0.3)), 4))
    left, right = hits["distance"][1, 0], hits["distance"][3, 0]
    assert left == 60.0
    assert right == pytest.approx(1.5 / math.sin(0.3))


def test_rays_pass_over_bodies_and_walls_below_the_sensor() -> None:
    rows = vehicles([(0.0, 0.0, 0.0), (10.0, 0.0, 0.0)], height=[1.5, 0.9])
    wall = np.array([(20.0, -5.0, 20.0, 5.0, 0.9, 0), (30.0, -5.0, 30.0, 5.0, 1.1, 1)], WALL)
    hits = scan(rows, full_circle(mount((0.0, 0.0, 1.0))), walls=wall)
    assert hits["distance"][0, 0] == 30.0
    assert hits["id"][0, 0] == -1
    low = scan(rows, full_circle(mount((0.0, 0.0, 0.8))), walls=wall)
    assert low["distance"][0, 0] == 7.5


def test_a_ray_at_the_corner_of_a_building_hits_it() -> None:
    corner = np.array([(10.0, 0.0, 15.0, 5.0, 8.0, 0), (15.0, -5.0, 10.0, 0.0, 8.0, 0)], WALL)
    hits = scan(vehicles([(0.0, 0.0, 0.0)]), full_circle(mount()), walls=corner)
    assert hits["distance"][0, 0] == pytest.approx(10.0)
    assert hits["what"][0, 0] <= WALL_HIT


@given(st.floats(3.0, 50.0), st.floats(-math.pi, math.pi), mounts())
def test_no_ray_that_meets_a_wall_is_skipped(
    distance: float, direction: float, matrix: Floats
) -> None:
    """Walls form a square around the vehicle, so every ray that is long enough hits a wall."""
    corners = [
        (distance * math.cos(direction + k * 0.5 * math.pi),
         distance * math.sin(direction + k * 0.5 * math.pi))
        for k in range(4)
    ]  # fmt: skip
    walls = np.array([(*corners[k], *corners[(k + 1) % 4], 1e3, k) for k in range(4)], WALL)
    matrix[:, 3] = 0.0, 0.0, 500.0
    fan = make_fan(matrix, (0.0, 2.0 * math.pi / 64, 64), LEVEL, 80.0)
    hits = scan(vehicles([(0.0, 0.0, 0.0)]), fan, walls=walls)
    flat = np.hypot(fan.rays[:, 0, 0], fan.rays[:, 0, 1])
    reached = distance < 80.0 * flat * math.sqrt(0.5)
    assert (hits["distance"][reached, 0] < 80.0).all()
