from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.errors import MissingExtraError
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.render import canvas as palette
from cavmarl.render.canvas import load_pygame
from cavmarl.render.cars import BRAKING_MPS2
from cavmarl.render.topdown import TopDownRenderer
from cavmarl.roads.network import SIGNAL_STATES, RoadNetwork
from cavmarl.roads.shown_signals import signal_codes

pytest.importorskip("pygame")

SIZE = (320, 240)
Car = Callable[..., NDArray[np.void]]


@pytest.fixture
def headless(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    load_pygame().display.quit()


def middle(frame: NDArray[np.uint8]) -> tuple[int, ...]:
    height, width = frame.shape[:2]
    return tuple(int(c) for c in frame[height // 2, width // 2])


def count(frame: NDArray[np.uint8], color: palette.Color) -> int:
    return int((np.abs(frame.astype(int) - color).sum(axis=2) < 30).sum())


def test_a_frame_is_rgb_of_the_requested_size(ring: RoadNetwork, car: Car) -> None:
    frame = TopDownRenderer(ring, SIZE).frame(car(agent=-1), title="ring", clock_s=1.0)
    assert frame.shape == (240, 320, 3)
    assert frame.dtype == np.uint8
    assert middle(frame) != palette.LAND
    assert tuple(frame[120, 130]) == palette.LAND


def test_the_picture_has_the_aspect_ratio_of_the_map(grid: RoadNetwork) -> None:
    width, height = TopDownRenderer(grid).size
    wide = TopDownRenderer(grid, focus=(0.0, 0.0, 5000.0, 10.0)).size
    assert width > height
    assert wide[0] > 2.5 * wide[1]
    assert width % 16 == height % 16 == 0


def test_equal_worlds_give_equal_pictures(grid: RoadNetwork, car: Car) -> None:
    rows = np.concatenate([car(x=100.0 * k, y=300.0, id=k, agent=k - 1) for k in range(5)])
    phases = grid.programs["first_phase"][grid.signals["program"]].astype(np.int32)
    one = TopDownRenderer(grid, SIZE).frame(rows, phases, clock_s=2.0)
    assert (TopDownRenderer(grid, SIZE).frame(rows[::-1], phases, clock_s=2.0) == one).all()


@pytest.mark.parametrize("agent", [-1, 0, 3, 25])
def test_a_vehicle_is_drawn_at_its_position_in_its_colour(
    ring: RoadNetwork, car: Car, agent: int
) -> None:
    renderer = TopDownRenderer(ring, SIZE, focus=(40.0, -20.0, 80.0, 10.0))
    row = car(agent=agent, x=60.0, y=-5.0, heading=1.0)
    expected = palette.BACKGROUND_CAR if agent < 0 else palette.agent_color(agent)
    assert middle(renderer.frame(row)) == expected
    assert middle(renderer.frame(row[:0])) != expected


def test_a_vehicle_is_drawn_with_its_length_and_width(ring: RoadNetwork, car: Car) -> None:
    renderer = TopDownRenderer(ring, SIZE, focus=(-10.0, -7.5, 10.0, 7.5))
    frame = renderer.frame(car(agent=2, length=12.0, width=3.0))
    scale = renderer.camera.scale
    body = np.abs(frame.astype(int) - palette.agent_color(2)).sum(axis=2) < 30
    rows, columns = np.nonzero(
        body & (np.arange(240) > 60)[:, None] & (np.arange(240) < 200)[:, None]
    )
    assert np.ptp(columns) + 1 == pytest.approx(12.0 * scale, abs=3.0)
    assert rows.max() - 120 == pytest.approx(1.5 * scale, abs=2.0)


def test_buildings_are_drawn_at_their_positions(ring: RoadNetwork) -> None:
    min_x, min_y, max_x, max_y = ring.extent_of(0)
    x, y = 0.5 * (min_x + max_x), 0.5 * (min_y + max_y)  # inside the ring road
    focus = (x - 10.0, y - 7.5, x + 10.0, y + 7.5)
    house = np.array(
        [(x - 4.0, y - 3.0), (x + 4.0, y - 3.0), (x + 4.0, y + 3.0), (x - 4.0, y + 3.0)]
    )
    built = replace(ring, roofs=house[None], roof_height=np.array([9.0]))
    nothing = np.zeros(0, VEHICLE)
    renderers = [TopDownRenderer(network, SIZE, focus=focus) for network in (built, ring)]
    seen, without = (count(one.frame(nothing), palette.BUILDING) for one in renderers)
    assert seen - without == pytest.approx(48.0 * renderers[0].camera.scale ** 2, rel=0.05)


@pytest.mark.parametrize(
    ("fields", "color"),
    [
        ({"accel": BRAKING_MPS2 - 0.5}, palette.BRAKE),
        ({"blinker": 1}, palette.BLINKER),
        ({"hit": 4}, palette.COLLIDED),
        ({"events": 1}, palette.COLLIDED),
    ],
)
def test_braking_blinking_and_collisions_are_drawn(
    ring: RoadNetwork, car: Car, fields: dict[str, float], color: palette.Color
) -> None:
    renderer = TopDownRenderer(ring, SIZE, focus=(-8.0, -6.0, 8.0, 6.0))
    calm = renderer.frame(car(agent=-1))
    shown = renderer.frame(car(agent=-1, **fields))
    assert count(shown, color) > count(calm, color)


def test_the_left_blinker_is_on_the_left_side(ring: RoadNetwork, car: Car) -> None:
    renderer = TopDownRenderer(ring, SIZE, focus=(-8.0, -6.0, 8.0, 6.0))
    left = renderer.frame(car(agent=-1, blinker=1))  # its left side is at the top
    assert count(left[:120], palette.BLINKER) > 0
    assert count(left[120:200], palette.BLINKER) == 0


def test_each_link_has_the_signal_state_of_its_phase(grid: RoadNetwork) -> None:
    phases = grid.programs["first_phase"][grid.signals["program"]].astype(np.int32)
    codes = signal_codes(grid, phases)
    signalled = grid.links["signal"] >= 0
    assert signalled.any()
    assert (codes[~signalled] == 255).all()
    for link in np.flatnonzero(signalled)[:20]:
        signal = grid.signals[grid.links[link]["signal"]]
        phase = grid.phases[grid.programs["first_phase"][signal["program"]]]
        states = grid.phase_states[phase["first_state"] :][: signal["num_links"]]
        letter = SIGNAL_STATES[states[grid.links[link]["signal_index"]]]
        assert SIGNAL_STATES[codes[link]] == letter


def test_stop_lines_switch_with_their_signal(grid: RoadNetwork) -> None:
    signal = grid.signals[0]
    first = grid.programs["first_phase"][grid.signals["program"]].astype(np.int32)
    red, green = palette.SIGNALS[0], palette.SIGNALS[3]
    links = np.flatnonzero(grid.links["signal"] == 0)
    renderer = TopDownRenderer(grid, SIZE)
    seen = set()
    for step in range(grid.programs["num_phases"][signal["program"]]):
        phases = first.copy()
        phases[0] += step
        link = int(links[0])
        lane = grid.lanes[grid.links[link]["from_lane"]]
        end = grid.points[lane["first_point"] + lane["num_points"] - 1]
        near = renderer.frame(
            np.zeros(0, dtype=VEHICLE), phases, center=(float(end["x"]), float(end["y"]))
        )
        letter = SIGNAL_STATES[signal_codes(grid, phases)[link]]
        around = near[115:125, 155:165]
        if letter in "rG":
            seen.add(letter)
            assert count(around, red if letter == "r" else green) > 0
            assert count(around, green if letter == "r" else red) == 0
    assert seen == {"r", "G"}


def test_the_camera_follows_an_agent_and_stops_without_it(grid: RoadNetwork, car: Car) -> None:
    renderer = TopDownRenderer(grid, SIZE)
    row = car(agent=5, x=150.0, y=200.0)
    renderer.draw(row, follow=[5])
    assert (renderer.camera.x, renderer.camera.y) == (150.0, 200.0)
    row["x"] += 20.0
    renderer.draw(row, follow=[5])
    assert 150.0 < renderer.camera.x < 170.0
    before = renderer.camera
    renderer.draw(row[:0], follow=[5])
    assert renderer.camera == before
    renderer.draw(row)
    assert renderer.camera.x == pytest.approx(300.0)


def test_destinations_are_marked(grid: RoadNetwork, car: Car) -> None:
    goals = np.flatnonzero(~grid.edges["internal"])[:1].astype(np.int32)[None]
    lane = grid.lanes[grid.edges[goals[0, 0]]["first_lane"]]
    end = grid.points[lane["first_point"] + lane["num_points"] - 1]
    row = car(agent=4, x=-1e6, goal=0)
    place = (float(end["x"]), float(end["y"]))
    plain = TopDownRenderer(grid, SIZE).frame(row, center=place)
    marked = TopDownRenderer(grid, SIZE, goal_edges=goals).frame(row, center=place)
    part = np.s_[90:150, 130:190]
    assert count(plain[part], palette.agent_color(4)) == 0
    assert count(marked[part], palette.agent_color(4)) > 10


def test_pictures_need_no_display_and_change_no_environment_variable(
    ring: RoadNetwork, car: Car, monkeypatch: pytest.MonkeyPatch
) -> None:
    load_pygame().display.quit()  # window of another test
    monkeypatch.setenv("SDL_VIDEODRIVER", "no-such-driver")
    before = dict(os.environ)
    TopDownRenderer(ring, SIZE).frame(car())
    assert dict(os.environ) == before
    assert not load_pygame().display.get_init()


def test_the_window_shows_the_drawn_frame(headless: None, ring: RoadNetwork, car: Car) -> None:
    renderer = TopDownRenderer(ring, SIZE)
    for _ in range(3):
        renderer.show(renderer.draw(car()), "ring", fps=1000.0)
    renderer.close()
    renderer.close()
    assert renderer.frame(car()).shape == (240, 320, 3)


def test_the_window_limits_the_frame_rate(headless: None, ring: RoadNetwork, car: Car) -> None:
    pygame = load_pygame()
    renderer = TopDownRenderer(ring, SIZE)
    picture = renderer.draw(car())
    renderer.show(picture, "ring", fps=50.0)
    start = pygame.time.get_ticks()
    for _ in range(5):
        renderer.show(picture, "ring", fps=50.0)
    assert pygame.time.get_ticks() - start >= 90
    renderer.close()


def test_a_closed_window_is_not_opened_again(
    headless: None, ring: RoadNetwork, car: Car, monkeypatch: pytest.MonkeyPatch
) -> None:
    pygame = load_pygame()
    opened = []
    window = pygame.Window

    def open_window(*arguments: object) -> object:
        opened.append(window(*arguments))
        return opened[-1]

    monkeypatch.setattr(pygame, "Window", open_window)
    renderer = TopDownRenderer(ring, SIZE)
    picture = renderer.draw(car())
    renderer.show(picture, "ring", fps=1000.0)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    renderer.show(picture, "ring", fps=1000.0)
    with pytest.raises(pygame.error):
        opened[0].get_surface()
    renderer.show(picture, "ring", fps=1000.0)
    assert len(opened) == 1


def test_the_error_without_pygame_names_the_extra(
    ring: RoadNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(module: str) -> None:
        raise ModuleNotFoundError(f"No module named '{module}'", name=module)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[render\]"):
        TopDownRenderer(ring)
