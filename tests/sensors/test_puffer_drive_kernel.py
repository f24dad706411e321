from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.config.sensors import PufferDriveConfig, SensorsConfig
from cavmarl.core.errors import ConfigError
from cavmarl.core.math.neighbors import fill_grid, make_grid
from cavmarl.sensors.kernels.puffer_drive_kernel import observe_puffer_drive
from cavmarl.sensors.observed import puffer_drive
from cavmarl.sensors.observed.road_segments import drive_lines, road_segments, spiral
from tests.naive import puffer_drive as naive
from tests.support.builders import crowds, vehicles
from tests.support.traffic import NAMES, network

PARTNERS, SEGMENTS, SPACING_M = 3, 60, 4.0
CONFIG = SensorsConfig(puffer_drive=PufferDriveConfig(True, PARTNERS, SEGMENTS, SPACING_M))
GOALS = np.array([[100.0, -40.0], [-300.0, 20.0]])
BEFORE = 2  # numbers of other sensors

SENSORS = {name: puffer_drive.settings(CONFIG, BEFORE, network(name), GOALS) for name in NAMES}
LINES = {name: drive_lines(network(name), SPACING_M) for name in NAMES}


def frame(name: str, rows: NDArray[np.void], i: int) -> NDArray[np.float32]:
    grid = make_grid(network(name).extent_m, 25.0, len(rows))
    fill_grid(rows, len(rows), grid)
    out = np.full(BEFORE + 6 + 7 * (PARTNERS + SEGMENTS), 9.0, np.float32)
    observe_puffer_drive(rows, i, grid, SENSORS[name], out)
    assert out[:BEFORE].tolist() == [9.0] * BEFORE
    return out[BEFORE:]


@given(
    crowds(), st.integers(0, 11), st.sampled_from(NAMES), st.floats(-0.1, 1.1), st.floats(-0.1, 1.1)
)
def test_the_observation_equals_twin(
    rows: NDArray[np.void], i: int, name: str, across: float, up: float
) -> None:
    i %= len(rows)
    min_x, min_y, max_x, max_y = network(name).extent_m
    rows["x"] += min_x + across * (max_x - min_x) - rows[i]["x"]
    rows["y"] += min_y + up * (max_y - min_y) - rows[i]["y"]
    rows["goal"] = 1
    lines, corner = LINES[name]
    twin = naive.observe(rows, i, tuple(GOALS[1]), lines, corner, PARTNERS, SEGMENTS)
    assert frame(name, rows, i) == pytest.approx(np.array(twin), abs=2e-5)


@given(crowds(), st.integers(0, 11), st.randoms(use_true_random=False))
def test_the_order_of_rows_does_not_matter(rows: NDArray[np.void], i: int, random: object) -> None:
    i %= len(rows)
    order = list(range(len(rows)))
    random.shuffle(order)  # type: ignore[attr-defined]
    again = frame("grid4x4", rows[order], order.index(i))
    np.testing.assert_array_equal(frame("grid4x4", rows, i), again)


def test_of_more_partners_the_lowest_ids_are_shown() -> None:
    rows = vehicles([(float(k), 0.0, 0.0) for k in range(6)], id=[9, 4, 8, 1, 7, 3])
    shown = frame("ring", rows, 0)[6 : 6 + 7 * PARTNERS].reshape(PARTNERS, 7)
    assert shown[:, 0] * 50.0 == pytest.approx([3.0, 5.0, 1.0])


def test_off_the_map_no_segment_is_seen() -> None:
    for place in ((5_000.0, 5_000.0, 0.0), (-5_000.0, 0.0, 0.0), (np.nan, 0.0, 0.0)):
        assert not frame("ring", vehicles([place]), 0)[6:].any()


def test_the_spiral_goes_round_once() -> None:
    assert list(map(tuple, spiral(21).tolist())) == naive.around(21)


@pytest.mark.parametrize("name", NAMES)
def test_every_segment_is_within_its_bounds(name: str) -> None:
    features = puffer_drive.features(CONFIG)
    low, high = (np.array([getattr(f, end) for f in features]) for end in ("low", "high"))
    for x, y, heading in np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3)):
        min_x, min_y, max_x, max_y = network(name).extent_m
        place = (
            (min_x + max_x + x * (max_x - min_x)) / 2,
            (min_y + max_y + y * (max_y - min_y)) / 2,
        )
        seen = frame(name, vehicles([(*place, 3.0 * heading)]), 0)
        assert np.all((low <= seen) & (seen <= high))


def test_a_map_that_is_too_large_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"puffer_drive\.segments = 1000000000: .* GB; use"):
        road_segments(network("ring"), 2.0, 10**9)
