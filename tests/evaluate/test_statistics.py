"""Intervals against what is known of them, trips against trips made by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config import TERMS
from cavmarl.evaluate.statistics import TripRecorder, mean_interval, share_interval

STEP_S = 0.5


def test_an_interval_of_nothing_says_so() -> None:
    assert mean_interval(np.zeros(0)).mean is None
    assert share_interval(0, 0).mean is None


def test_one_value_has_a_mean_and_no_interval() -> None:
    found = mean_interval(np.array([3.0]))
    assert (found.mean, found.low, found.high) == (3.0, None, None)


def test_bootstrap_covers_as_often_as_it_says() -> None:
    random = np.random.default_rng(0)
    hits = 0
    for _ in range(100):
        found = mean_interval(random.normal(5.0, 2.0, 60))
        assert found.low is not None
        assert found.high is not None
        hits += found.low <= 5.0 <= found.high
    assert 87 <= hits <= 99


def test_wilson_equals_the_textbook() -> None:
    # Newcombe 1998, table I: 81 of 263 and 15 of 148.
    for hits, total, low, high in ((81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605)):
        found = share_interval(hits, total)
        assert (found.low, found.high) == pytest.approx((low, high), abs=1e-4)


@pytest.mark.parametrize("hits", [0, 10])
def test_wilson_stays_a_share(hits: int) -> None:
    found = share_interval(hits, 10)
    assert found.low is not None
    assert found.high is not None
    assert 0.0 <= found.low < found.high <= 1.0


class Worlds:
    """One agent in each of two worlds, with terms by name."""

    def __init__(self, max_steps: int = 8) -> None:
        self.recorder = TripRecorder(2, 1, max_steps, STEP_S)
        self.step = 0

    def add(
        self,
        acted: tuple[bool, bool] = (True, True),
        done: tuple[bool, bool] = (False, False),
        over: tuple[bool, bool] = (False, False),
        **terms: tuple[float, float],
    ) -> None:
        values: NDArray[np.float32] = np.zeros((2, 1, len(TERMS)), dtype=np.float32)
        for name, pair in terms.items():
            values[:, 0, TERMS.index(name)] = pair
        column = (np.array(flags)[:, None] for flags in (acted, done))
        self.recorder.add(self.step, next(column), values, next(column), np.array(over))
        self.step += 1


def test_a_trip_is_the_sum_of_its_steps() -> None:
    worlds = Worlds()
    worlds.add(progress=(2.0, 1.0), comfort=(0.1, 0.0), time_to_collision=(0.25, 0.0))
    worlds.add(
        progress=(4.0, 1.0),
        comfort=(0.3, 0.0),
        delay=(0.2, 0.0),
        red_light=(1.0, 0.0),
        speed=(0.3, 0.0),
    )
    worlds.add(done=(True, True), progress=(6.0, 1.0), arrival=(1.0, 0.0), collision=(0.0, 1.0))
    trips = worlds.recorder.trips()
    assert trips.count == 2
    assert trips.arrived.tolist() == [True, False]
    assert trips.collided.tolist() == [False, True]
    assert trips.red_light.tolist() == [True, False]
    assert trips.distance_m.tolist() == [12.0, 3.0]
    assert trips.duration_s.tolist() == [3 * STEP_S] * 2
    assert trips.delay_s == pytest.approx([0.2, 0.0])
    assert trips.mean_speeding == pytest.approx([0.1, 0.0])
    assert trips.mean_jerk_mps3 == pytest.approx([4.0 / 3.0, 0.0])
    assert trips.least_ttc_s == pytest.approx([3.0, 4.0])


def test_the_terms_of_a_step_without_an_agent_do_not_count() -> None:
    worlds = Worlds()
    worlds.add(acted=(True, False), progress=(2.0, 99.0))
    worlds.add(done=(True, True), progress=(2.0, 1.0))
    assert worlds.recorder.trips().distance_m.tolist() == [4.0, 1.0]


def test_a_seat_makes_one_trip_after_the_other() -> None:
    worlds = Worlds()
    worlds.add(done=(True, False), arrival=(1.0, 0.0), progress=(5.0, 1.0))
    worlds.add(acted=(False, True), progress=(0.0, 1.0))
    worlds.add(done=(True, True), off_road=(1.0, 0.0), progress=(3.0, 1.0))
    trips = worlds.recorder.trips()
    assert sorted(trips.distance_m.tolist()) == [3.0, 3.0, 5.0]
    assert trips.arrived.sum() == trips.off_road.sum() == 1


def test_the_horizon_cuts_a_trip_and_it_is_neither() -> None:
    worlds = Worlds(max_steps=2)
    worlds.add()
    worlds.add(over=(True, True))
    trips = worlds.recorder.trips()
    assert trips.count == 2
    assert not (trips.arrived | trips.collided | trips.off_road).any()


def test_trips_of_the_second_half_do_not_count_however_they_end() -> None:
    worlds = Worlds(max_steps=4)
    for _ in range(2):
        worlds.add(acted=(False, True))
    worlds.add(done=(True, True), arrival=(1.0, 1.0))
    worlds.add(over=(True, True))
    trips = worlds.recorder.trips()
    assert trips.count == 1
    assert trips.duration_s.tolist() == [3 * STEP_S]
