"""Pictures of divided worlds: zones, owners, ghosts and transfers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("pygame", reason="pictures need the extra 'render'")

from cavmarl import parallel_env
from cavmarl.core.errors import ConfigError
from cavmarl.handoff.zone_view import TransferInFlight, ZoneView
from cavmarl.render import canvas as palette
from cavmarl.render.canvas import blank, pixels
from cavmarl.render.topdown import MARGIN_PX, TopDownRenderer
from cavmarl.render.viewport import Viewport
from cavmarl.render.zone_overlay import draw_sight
from cavmarl.roads.network import RoadNetwork
from tests.support.partitions import PINWHEEL, four

SIZE = (640, 480)
FOCUS = (-20.0, -15.0, 20.0, 15.0)
CAMERA = Viewport.fit(FOCUS, SIZE, MARGIN_PX)
BORDERS = four(0.0, 0.0)
NOBODY = tuple(np.zeros(0, dtype=np.int64) for _ in range(4))
Car = Callable[..., NDArray[np.void]]


def view_of(owners: list[int]) -> ZoneView:
    return ZoneView(BORDERS, 1.5, np.array(owners), NOBODY)


def picture(
    ring: RoadNetwork, rows: NDArray[np.void], view: ZoneView, ghosts_of: int | None = None
) -> NDArray[np.uint8]:
    return TopDownRenderer(ring, SIZE, FOCUS).frame(rows, zones=view, ghosts_of=ghosts_of)


def color_at(frame: NDArray[np.uint8], x: float, y: float) -> tuple[int, ...]:
    """Return the colour at a point in metres."""
    column, row = pixel(x, y)
    return tuple(int(c) for c in frame[row, column])


def pixel(x: float, y: float) -> tuple[int, int]:
    column, row = CAMERA.to_pixels(np.array([x, y])).round().astype(int).tolist()
    return column, row


def count(frame: NDArray[np.uint8], color: palette.Color) -> int:
    return int((np.abs(frame.astype(int) - color).sum(axis=2) < 12).sum())


@pytest.mark.parametrize("agent", [-1, 3])
@pytest.mark.parametrize("owner", [0, 1, 2, 3])
def test_a_vehicle_has_the_colour_of_its_owning_zone(
    ring: RoadNetwork, car: Car, owner: int, agent: int
) -> None:
    rows = car(x=5.0, y=9.0, id=5, agent=agent)
    frame = picture(ring, rows, view_of([owner]))
    assert color_at(frame, 5.0, 9.0) == palette.zone_color(owner)


def test_each_zone_has_a_tint_and_a_border(ring: RoadNetwork, car: Car) -> None:
    frame = picture(ring, car()[:0], view_of([]))
    # Four points beside the roads, one in each zone.
    tints = {color_at(frame, x, y) for x in (-4.0, 4.0) for y in (-4.0, 4.0)}
    assert len(tints) == 4
    assert color_at(frame, 10.0, 0.0) == color_at(frame, 0.0, 10.0) == palette.INK
    plain = TopDownRenderer(ring, SIZE, FOCUS).frame(car()[:0])
    for x, y in ((-4.0, -4.0), (8.0, 10.0)):
        lost = np.array(color_at(plain, x, y)) - color_at(frame, x, y)
        assert 0 < np.abs(lost).max() < 80, "the tint is missing or too strong"


def test_ghosts_of_the_chosen_zone_have_a_rim(ring: RoadNetwork, car: Car) -> None:
    rows = np.concatenate([car(x=6.0, y=5.0, id=1), car(x=13.0, y=5.0, id=2)])
    ghosts = (np.array([1]), np.array([2]), NOBODY[2], NOBODY[3])
    view = replace(view_of([3, 3]), ghosts=ghosts)
    plain = picture(ring, rows, view)
    seen = {zone: picture(ring, rows, view, ghosts_of=zone) for zone in (0, 1, 2)}
    rim = palette.zone_color

    def around(frame: NDArray[np.uint8], x: float) -> NDArray[np.uint8]:
        column, row = pixel(x, 5.0)
        return frame[row - 24 : row + 24, column - 42 : column + 42]

    assert count(around(seen[0], 6.0), rim(0)) > 20 > count(around(plain, 6.0), rim(0))
    assert count(around(seen[1], 13.0), rim(1)) > 20 > count(around(plain, 13.0), rim(1))
    # Zone 2 has no ghosts.
    np.testing.assert_array_equal(around(seen[2], 6.0), around(plain, 6.0))
    for frame in seen.values():
        assert color_at(frame, 6.0, 5.0) == palette.zone_color(3)


def test_the_line_around_the_area_that_a_zone_sees_is_at_the_end_of_its_halo() -> None:
    surface = blank((300, 300))
    surface.fill((255, 255, 255))
    draw_sight(surface, PINWHEEL, 3.0, 4, Viewport.fit(PINWHEEL.bounds, (300, 300)))
    image = pixels(surface)
    lined = np.argwhere(np.abs(image.astype(int) - palette.zone_color(4)).sum(axis=2) < 12)
    # Zone 4 has x and y from 10 to 20 m, and its halo is 3 m wide; 1 m is 10 pixels.
    assert lined.min(axis=0).tolist() == pytest.approx([70, 70], abs=6)
    assert lined.max(axis=0).tolist() == pytest.approx([230, 230], abs=6)
    assert (image[150, 150] == 255).all()
    assert (image[72, 72] == 255).all(), "the corner of the line is not round"


def test_a_transfer_has_a_ring_and_an_arrow_to_the_target_zone(ring: RoadNetwork, car: Car) -> None:
    rows = car(x=-1.5, y=8.0, id=4)
    still = view_of([2])
    moving = replace(still, transfers=(TransferInFlight(4, 2, 3, "offered"),))
    before, after = picture(ring, rows, still), picture(ring, rows, moving)
    # Ignore the line of text at the top, which has the number of transfers.
    changed = np.argwhere((before[80:] != after[80:]).any(axis=2)) + np.array([80, 0])
    column, row = pixel(-1.5, 8.0)
    offsets = changed - np.array([row, column])
    half_m = 0.5 * float(rows["length"][0])
    away_m = np.hypot(*offsets.T) / CAMERA.scale
    assert half_m < away_m.min(), "the ring touches the car"
    assert away_m.max() < half_m + 2.0
    # The arrow points to the target zone in the east.
    assert offsets[:, 1].max() > 6 - offsets[:, 1].min()
    assert count(after[80:], palette.zone_color(3)) > count(before[80:], palette.zone_color(3))
    assert color_at(after, -1.5, 8.0) == palette.zone_color(2)


def test_a_transfer_of_a_vehicle_that_has_left_is_not_drawn(ring: RoadNetwork, car: Car) -> None:
    rows = car(x=-1.5, y=8.0, id=4)
    gone = replace(view_of([2]), transfers=(TransferInFlight(9, 2, 3, "offered"),))
    shown = picture(ring, rows, gone)
    np.testing.assert_array_equal(shown[80:], picture(ring, rows, view_of([2]))[80:])


def test_a_picture_does_not_depend_on_the_order_of_vehicles(ring: RoadNetwork, car: Car) -> None:
    rows = np.concatenate([car(x=4.0 * k - 8.0, y=5.0, id=k) for k in range(5)])
    view = view_of([0, 1, 2, 3, 0])
    other = replace(view, owners=view.owners[::-1])
    np.testing.assert_array_equal(
        picture(ring, rows, view), picture(ring, rows[::-1].copy(), other)
    )


# Machado, Oliveira, Fernandes, A physiologically-based model for simulation of color vision
# deficiency (2009), severity 1; on linear light.
PROTANOPIA = [
    [0.152286, 1.052583, -0.204868],
    [0.114503, 0.786281, 0.099216],
    [-0.003882, -0.048116, 1.051998],
]
DEUTERANOPIA = [
    [0.367322, 0.860646, -0.227968],
    [0.280085, 0.672501, 0.047413],
    [-0.011820, 0.042940, 0.968881],
]
TRITANOPIA = [
    [1.255528, -0.076749, -0.178779],
    [-0.078411, 0.930809, 0.147602],
    [0.004733, 0.691367, 0.303900],
]


@pytest.mark.parametrize("vision", [np.eye(3), PROTANOPIA, DEUTERANOPIA, TRITANOPIA])
def test_the_colours_of_zones_differ_for_any_colour_vision(vision: NDArray[np.float64]) -> None:
    linear = (np.array(palette.ZONES) / 255.0) ** 2.2
    seen = np.clip(linear @ np.array(vision).T, 0.0, 1.0) ** (1 / 2.2)
    least = min(float(np.linalg.norm(a - b)) for a, b in combinations(seen, 2))
    assert least > 0.1


def test_an_environment_shows_its_zones() -> None:
    settings = {"agents": 6, "background": 40, "seed": 0, "render_mode": "rgb_array"}
    whole, divided = (parallel_env("grid4x4", zones=zones, **settings) for zones in (1, 4))
    frames = []
    for env in (whole, divided):
        env.reset()
        frame = env.render()
        assert frame is not None
        frames.append(frame)
    assert frames[0].shape == frames[1].shape
    divided.ghosts_of = 2
    ghosts = divided.render()
    assert ghosts is not None
    frames.append(ghosts)
    for one, other in combinations(frames, 2):
        assert (one != other).any(axis=2).mean() > 0.005
    for env, zone in ((divided, 4), (divided, -1), (whole, 1)):
        env.ghosts_of = zone
        with pytest.raises(ConfigError, match=f"ghosts_of = {zone}: the world has the zones 0 to"):
            env.render()
