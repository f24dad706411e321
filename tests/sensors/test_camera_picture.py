from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.roads.kernels.backdrop_pieces import WALL
from cavmarl.sensors.kernels.camera_picture import (
    colours,
    find_faces,
    look,
    make_camera,
    make_picture,
    measure_depths,
    write_classes,
    write_colours,
    write_halves,
)
from cavmarl.sensors.kernels.panorama import BUILDING, CAR, GROUND, NOTHING, PEDESTRIAN, ROAD
from cavmarl.sensors.kernels.polygon_fill import CameraPose, PixelRows
from cavmarl.sensors.kernels.rig_pictures import camera_reach_m
from tests.naive import imaging as naive
from tests.support.builders import crowds, vehicles
from tests.support.imaging import NO_WALLS, backdrop, look_around, mount, mounts, wall_sets

Floats = NDArray[np.float64]
RIGHT = 0.5 * math.pi
WIDTH, HEIGHT = 16, 10
CLASS_OF = {"body": CAR, "wall": BUILDING, "ground": GROUND, "": NOTHING}


def shoot(
    rows: NDArray[np.void],
    camera: CameraPose,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    walls: NDArray[np.void] = NO_WALLS,
    strips: Floats | None = None,
    row: int = 0,
) -> tuple[NDArray[np.float32], NDArray[np.uint8], PixelRows]:
    """Return the depths, the classes and the pixel rows of a picture."""
    reach_m = camera_reach_m(camera, *size) + 1.0  # a pitched vehicle moves its camera by up to 1 m
    panorama, counts = look_around(rows, row, backdrop(walls, strips), reach_m)
    picture = make_picture(*size, panorama)
    num = find_faces(camera, panorama, counts, picture)
    look(camera, picture, num, 0, size[1])
    depths = np.zeros(size[::-1], np.float32)
    classes = np.zeros(size[::-1], np.uint8)
    write_classes(picture, classes)
    measure_depths(camera, picture, 0, depths)
    return depths, classes, picture


@given(crowds(most=6), wall_sets(), mounts(), st.integers(1, HEIGHT))
def test_pixel_rows_do_not_depend_on_the_bands_in_which_they_are_rendered(
    rows: NDArray[np.void], walls: NDArray[np.void], matrix: Floats, band: int
) -> None:
    """Large pictures are rendered in bands of rows, and a worker may render only some bands."""
    camera = make_camera(matrix, WIDTH, RIGHT, 60.0)
    depths, classes, _ = shoot(rows, camera, walls=walls)
    reach_m = camera_reach_m(camera, WIDTH, HEIGHT) + 1.0
    panorama, counts = look_around(rows, 0, backdrop(walls), reach_m)
    picture = make_picture(WIDTH, HEIGHT, panorama)
    num = find_faces(camera, panorama, counts, picture)
    for first in reversed(range(0, HEIGHT, band)):
        last = min(first + band, HEIGHT)
        own_depths = np.zeros((last - first, WIDTH), np.float32)
        own_classes = np.zeros((last - first, WIDTH), np.uint8)
        look(camera, picture, num, first, last)
        write_classes(picture, own_classes)
        measure_depths(camera, picture, first, own_depths)
        assert (own_classes == classes[first:last]).all()
        assert (own_depths == depths[first:last]).all()


def forward(range_m: float = 60.0, width: int = WIDTH, z_m: float = 1.0) -> CameraPose:
    return make_camera(mount((0.0, 0.0, z_m)), width, RIGHT, range_m)


def stands_in(wall: np.void, row: np.void, mounted: Floats) -> bool:
    """Return whether a camera is inside or on top of a wall, where it sees no side of the wall."""
    turned = np.exp(1j * row["heading"]) * complex(mounted[0], mounted[1])
    camera = complex(row["x"], row["y"]) + turned
    one, other = complex(wall["ax"], wall["ay"]), complex(wall["bx"], wall["by"])
    further = abs(camera - one) + abs(camera - other) - abs(one - other)
    return bool(further < 1e-6 and mounted[2] <= wall["height"] + 1e-6)


@given(
    crowds(most=6), wall_sets(), mounts(), st.sampled_from([0.5, RIGHT, 2.5]),
    st.sampled_from([20.0, 60.0]), st.sampled_from([0.0, -0.1]),
)  # fmt: skip
def test_pixels_equal_twin(
    rows: NDArray[np.void],
    walls: NDArray[np.void],
    matrix: Floats,
    fov: float,
    range_m: float,
    pitch: float,
) -> None:
    rows["pitch"][0] = pitch
    assume(not any(stands_in(wall, rows[0], matrix[:, 3]) for wall in walls))
    camera = make_camera(matrix, WIDTH, fov, range_m)
    depths, classes, _ = shoot(rows, camera, walls=walls)
    start = matrix[:, 3]
    for j, i in np.ndindex(HEIGHT, WIDTH):
        ray = naive.pixel_ray(matrix[:, :3], WIDTH, HEIGHT, fov, j, i)
        exact = naive.trace(rows, 0, walls, start, ray, range_m, 0.0)
        if exact.distance < 0.02:
            continue  # a camera inside a body sees no face of it
        is_equal = depths[j, i] == pytest.approx(exact.distance, rel=1e-5, abs=1e-4)
        if is_equal and classes[j, i] == CLASS_OF[exact.what[0]]:
            continue
        nearer, further = (
            naive.trace(rows, 0, walls, start, ray, range_m, margin) for margin in (1e-6, -1e-6)
        )
        is_sure = nearer.what == further.what and abs(nearer.distance - further.distance) < 1e-3
        assert not is_sure, (j, i, depths[j, i], classes[j, i], exact)


@given(crowds(), mounts(), st.randoms(use_true_random=False))
def test_the_order_of_rows_does_not_matter(
    rows: NDArray[np.void], matrix: Floats, random: object
) -> None:
    order = list(range(len(rows)))
    random.shuffle(order)  # type: ignore[attr-defined]
    camera = make_camera(matrix, WIDTH, RIGHT, 60.0)
    for place, row in enumerate(order):
        once, again = shoot(rows, camera, row=row), shoot(rows[order], camera, row=place)
        assert once[0].tobytes() == again[0].tobytes()
        assert once[1].tobytes() == again[1].tobytes()


def test_a_wall_ten_metres_ahead_has_the_depth_10_m_in_every_pixel() -> None:
    wall = np.array([(10.0, -40.0, 10.0, 40.0, 80.0, 0)], WALL)
    depths, classes, _ = shoot(vehicles([(0.0, 0.0, 0.0)]), forward(z_m=1.5), walls=wall)
    above = HEIGHT // 2
    assert (depths[:above] == 10.0).all()
    assert (classes[:above] == BUILDING).all()
    assert (classes[-1] == GROUND).all()
    # The depth of the ground is the height of the camera divided by the slope of the lowest row.
    slope = (HEIGHT - 0.5 - 0.5 * HEIGHT) / (0.5 * WIDTH)
    assert depths[-1] == pytest.approx(1.5 / slope)


def test_a_long_body_ten_metres_ahead_has_the_depth_10_m() -> None:
    rows = vehicles([(0.0, 0.0, 0.0), (11.0, 0.0, RIGHT)], length=60.0, height=4.0)
    depths, classes, _ = shoot(rows, forward())
    middle = HEIGHT // 2 - 1
    assert depths[middle] == pytest.approx(10.0)
    assert (classes[middle] == CAR).all()


def test_the_nearer_body_hides_the_other() -> None:
    rows = vehicles([(0.0, 0.0, 0.0), (20.0, 0.0, RIGHT), (10.0, 0.0, RIGHT)], length=60.0)
    rows["vtype"][2] = 1
    _, classes, _ = shoot(rows, forward(z_m=0.8))
    middle = HEIGHT // 2 - 1
    assert (classes[middle] == PEDESTRIAN).all()
    wall = np.array([(5.0, -40.0, 5.0, 40.0, 8.0, 0)], WALL)
    _, classes, _ = shoot(rows, forward(z_m=0.8), walls=wall)
    assert (classes[middle] == BUILDING).all()


def test_the_left_side_of_a_picture_is_left_and_its_top_is_up() -> None:
    left = vehicles([(0.0, 0.0, 0.0), (10.0, 6.0, 0.0)])
    _, classes, _ = shoot(left, forward())
    seen = np.argwhere(classes == CAR)
    assert seen[:, 1].max() < WIDTH // 2
    assert (classes[0] == NOTHING).all()
    assert (classes[-1] == GROUND).all()


def test_a_camera_rolled_by_90_degrees_sees_the_horizon_vertical() -> None:
    camera = make_camera(mount((0.0, 0.0, 1.0), (0.0, 0.0, RIGHT)), WIDTH, RIGHT, 60.0)
    _, classes, _ = shoot(vehicles([(0.0, 0.0, 0.0)]), camera)
    # The left side of the camera points up, so the sky is on the left.
    assert (classes[:, 0] == NOTHING).all()
    assert (classes[:, -1] == GROUND).all()


def test_roads_lie_on_the_ground_and_bodies_stand_on_them() -> None:
    strip = np.array([[(0.0, -2.0), (0.0, 2.0), (50.0, 2.0), (50.0, -2.0)]])
    rows = vehicles([(0.0, 0.0, 0.0), (12.0, 0.0, 0.0)])
    _, classes, _ = shoot(rows, forward(), strips=strip)
    assert classes[-1, WIDTH // 2] == ROAD
    assert classes[HEIGHT // 2, 0] == GROUND
    assert classes[HEIGHT // 2, WIDTH // 2] == CAR


def test_neighbouring_faces_leave_no_gap() -> None:
    """No ground or sky is visible inside the outline of a rotated body."""
    for heading in np.linspace(0.0, math.pi, 25):
        rows = vehicles([(0.0, 0.0, 0.0), (8.0, 0.3, heading)])
        _, classes, _ = shoot(rows, forward(width=64, z_m=1.6), (64, 40))
        for line in classes:
            seen = np.flatnonzero(line == CAR)
            assert len(seen) == 0 or len(seen) == seen[-1] - seen[0] + 1


def test_float16_numbers_equal_those_of_numpy() -> None:
    values = np.geomspace(0.01, 300.0, 4001, dtype=np.float32).reshape(1, -1)
    ties = (np.arange(2048, 4096, dtype=np.float32) / 16.0 + 1.0 / 32.0).reshape(1, -1)
    for floats in (values, ties):
        out = np.zeros(floats.shape, np.uint16)
        write_halves(floats.view(np.uint32), out)
        assert (out.view(np.float16) == floats.astype(np.float16)).all()


def test_colours_depend_on_the_class_and_fade_with_the_distance() -> None:
    rows = vehicles(
        [(0.0, 0.0, 0.0), (6.0, 0.0, RIGHT), (40.0, 0.0, RIGHT)], length=[5, 3, 120], height=6.0
    )
    camera = forward()
    _, classes, picture = shoot(rows, camera)
    out = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    write_colours(camera, picture, 0, colours(), out)
    middle = HEIGHT // 2 - 1
    near, far = out[middle, WIDTH // 2].astype(int), out[middle, 0].astype(int)
    assert classes[middle, 0] == classes[middle, WIDTH // 2] == CAR
    assert near[0] - near[2] > far[0] - far[2] > 0
    assert (out[0, 0] == colours()[NOTHING]).all()
