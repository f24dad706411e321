"""Records of trips and episodes from steps with known terms."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.terms import TERMS
from cavmarl.evaluate.recorder import Recorder

STEP_S = 0.5
WEIGHTS = np.array([2.0 if term == "progress" else 0.0 for term in TERMS])


class Worlds:
    """Two worlds with one agent each; `add` records a step with the given terms."""

    def __init__(self, max_steps: int = 8) -> None:
        self.recorder = Recorder(2, 1, max_steps, STEP_S, WEIGHTS)
        self.step = 0

    def add(
        self,
        acted: tuple[bool, bool] = (True, True),
        done: tuple[bool, bool] = (False, False),
        over: tuple[bool, bool] = (False, False),
        arrivals: tuple[int, int] = (0, 0),
        **terms: tuple[float, float],
    ) -> None:
        values: NDArray[np.float32] = np.zeros((2, 1, len(TERMS)), dtype=np.float32)
        for name, pair in terms.items():
            values[:, 0, TERMS.index(name)] = pair
        rewards = (values @ WEIGHTS).astype(np.float32)
        column = (np.array(flags)[:, None] for flags in (acted, done))
        self.recorder.add(
            self.step,
            next(column),
            rewards,
            values,
            next(column),
            np.array(over),
            np.array(arrivals),
        )
        self.step += 1

    @property
    def trips(self) -> NDArray[np.void]:
        return self.recorder.trips()


def test_a_trip_sums_and_averages_its_steps() -> None:
    worlds = Worlds()
    worlds.add(progress=(2.0, 1.0), jerk=(0.1, 0.0), ttc_risk=(0.5, 0.0), energy=(-0.5, 0.0))
    worlds.add(
        progress=(4.0, 1.0),
        jerk=(0.3, 0.0),
        delay=(0.2, 0.0),
        energy=(2.0, -0.5),
        co2=(3.0, 0.0),
        red_light=(1.0, 0.0),
        speeding=(0.3, 0.0),
        ttc_risk=(0.7, 0.0),
    )
    worlds.add(done=(True, True), progress=(6.0, 1.0), arrival=(1.0, 0.0), collision=(0.0, 1.0))
    trips = worlds.trips
    assert trips["arrived"].tolist() == [True, False]
    assert trips["collision"].tolist() == [False, True]
    assert trips["red_light"].tolist() == [True, False]
    assert trips["distance_m"].tolist() == [12.0, 3.0]
    assert trips["duration_s"].tolist() == [3 * STEP_S] * 2
    assert trips["mean_speed_mps"].tolist() == [8.0, 2.0]
    assert trips["reward"].tolist() == [24.0, 6.0]
    assert trips["delay_s"] == pytest.approx([0.2, 0.0])
    assert trips["energy_wh"] == pytest.approx([1.5, -0.5])
    assert trips["co2_g"] == pytest.approx([3.0, 0.0])
    assert trips["mean_speeding"] == pytest.approx([0.1, 0.0])
    assert trips["mean_jerk_mps3"] == pytest.approx([4.0 / 3.0, 0.0])
    assert trips["least_ttc_s"] == pytest.approx([1.2, 4.0])
    # A risk of 0.7 is a time to collision of 1.2 s, and 0.5 is 2 s. So one step of three is below
    # 1.5 s.
    assert trips["short_ttc_share"] == pytest.approx([1.0 / 3.0, 0.0])
    assert np.isnan(trips["least_pet_s"]).all()


def test_the_terms_of_a_step_without_an_agent_do_not_count() -> None:
    worlds = Worlds()
    worlds.add(acted=(True, False), progress=(2.0, 99.0))
    worlds.add(done=(True, True), progress=(2.0, 1.0))
    assert worlds.trips["distance_m"].tolist() == [4.0, 1.0]
    assert worlds.trips["began_s"].tolist() == [0.0, STEP_S]


def test_an_agent_has_several_trips_one_after_the_other() -> None:
    worlds = Worlds()
    worlds.recorder.least_pet_s[0] = 1.5
    worlds.add(done=(True, False), arrival=(1.0, 0.0), progress=(5.0, 1.0))
    worlds.add(acted=(False, True), progress=(0.0, 1.0))
    worlds.add(done=(True, True), off_road=(1.0, 0.0), progress=(3.0, 1.0))
    trips = worlds.trips
    assert trips["distance_m"].tolist() == [5.0, 3.0, 3.0]
    assert trips["success"].tolist() == [True, False, False]
    assert trips["off_road"].tolist() == [False, True, False]
    assert trips["least_pet_s"][0] == 1.5
    assert np.isnan(trips["least_pet_s"][1:]).all()


def test_trips_below_a_metre_do_not_count_for_the_gini_coefficient_of_delays() -> None:
    worlds = Worlds()
    worlds.add(done=(True, True), delay=(1.0, 1.0), progress=(10.0, 10.0))
    worlds.add(done=(True, True), over=(True, True), delay=(1.0, 1.0), progress=(0.9, 1.1))
    even, uneven = worlds.recorder.episodes()["gini_delay"]
    assert even == 0.0
    assert uneven > 0.1


def test_vehicles_with_negative_distance_have_speed_0_in_jains_index() -> None:
    worlds = Worlds()
    worlds.add(done=(True, True), progress=(4.0, 4.0))
    worlds.add(done=(True, True), over=(True, True), progress=(-4.0, 4.0))
    assert worlds.recorder.episodes()["jain_speed"].tolist() == [0.5, 1.0]


def test_an_encroachment_after_ten_seconds_does_not_count() -> None:
    worlds = Worlds()
    worlds.recorder.least_pet_s[:, 0] = 9.9, 10.1
    worlds.add(done=(True, True))
    np.testing.assert_array_equal(worlds.trips["least_pet_s"], [9.9, np.nan])


def test_collided_and_off_road_vehicles_do_not_arrive() -> None:
    worlds = Worlds()
    worlds.add(collision=(1.0, 0.0), off_road=(0.0, 1.0))
    worlds.add(done=(True, True), arrival=(1.0, 1.0))
    trips = worlds.trips
    assert trips["collision"].tolist() == [True, False]
    assert trips["off_road"].tolist() == [False, True]
    assert not (trips["success"] | trips["arrived"] | trips["unfinished"]).any()


def test_a_trip_truncated_by_the_horizon_is_unfinished() -> None:
    worlds = Worlds(max_steps=2)
    worlds.add()
    worlds.add(over=(True, True))
    trips = worlds.trips
    assert trips["unfinished"].tolist() == [True, True]
    assert not (trips["arrived"] | trips["collision"] | trips["off_road"]).any()


@pytest.mark.parametrize("fault", ["red_light", "wrong_way"])
def test_a_trip_that_breaks_a_rule_is_not_a_success(fault: str) -> None:
    worlds = Worlds()
    worlds.add(**{fault: (1.0, 0.0)})
    worlds.add(done=(True, True), arrival=(1.0, 1.0))
    assert worlds.trips["arrived"].tolist() == [True, True]
    assert worlds.trips["success"].tolist() == [False, True]


def test_a_trip_over_three_times_the_free_time_is_not_a_success() -> None:
    worlds = Worlds()
    worlds.add(delay=(STEP_S, STEP_S))
    worlds.add(delay=(STEP_S, STEP_S))
    worlds.add(done=(True, True), arrival=(1.0, 1.0), delay=(0.0, 0.01 * STEP_S))
    assert worlds.trips["arrived"].tolist() == [True, True]
    # The trips take 3 steps. Their free times are 1 and 0.99 steps.
    assert worlds.trips["success"].tolist() == [True, False]


def test_trips_that_begin_in_the_second_half_of_an_episode_do_not_count() -> None:
    worlds = Worlds(max_steps=4)
    for _ in range(2):
        worlds.add(acted=(False, True))
    worlds.add(done=(True, True), arrival=(1.0, 1.0))
    worlds.add(acted=(False, False), over=(True, True))
    assert worlds.trips["counted"].tolist() == [False, True]


def test_an_episode_has_the_parts_of_its_return_and_its_arrivals_per_hour() -> None:
    worlds = Worlds(max_steps=4)
    worlds.add(progress=(2.0, 1.0))
    worlds.add(progress=(3.0, 1.0), done=(True, False), arrival=(1.0, 0.0))
    worlds.add(acted=(False, True), over=(False, True), progress=(0.0, 1.0), arrivals=(2, 3))
    worlds.add(acted=(False, False), over=(True, False), arrivals=(5, 0))
    episodes = worlds.recorder.episodes()
    assert episodes["duration_s"].tolist() == [4 * STEP_S, 3 * STEP_S]
    assert episodes["trips"].tolist() == [1, 1]
    assert episodes["episode_return"].tolist() == [10.0, 6.0]
    assert episodes["reward_progress"].tolist() == [10.0, 6.0]
    assert episodes["reward_arrival"].tolist() == [0.0, 0.0]
    assert episodes["agent_arrivals_per_h"].tolist() == [3600.0 / 2.0, 0.0]
    others = [4 * 3600.0 / 2.0, 3 * 3600.0 / 1.5]
    assert episodes["background_arrivals_per_h"].tolist() == pytest.approx(others)
    assert episodes["jain_speed"].tolist() == pytest.approx([1.0, 1.0])
