"""Returns and ends of trips during training, compared with hand-computed values."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl.config.terms import TERMS
from cavmarl.learning.log import Trips


def step(
    trips: Trips, reward: tuple[float, float], ends: str = "", *, red: bool = False
) -> dict[str, float]:
    """Add a step of two agents; in `ends`, a means arrival, c truncation and - no end."""
    terms = np.zeros((1, 2, len(TERMS)), np.float32)
    done, cut = np.zeros((2, 1, 2), np.bool_)
    for agent, letter in enumerate(ends):
        done[0, agent], cut[0, agent] = letter == "a", letter == "c"
        terms[0, agent, TERMS.index("arrival")] = letter == "a"
    terms[0, 0, TERMS.index("red_light")] = red
    trips.add(np.array([reward], np.float32), done, cut, terms)
    return trips.means()


def test_the_return_of_a_trip_is_the_sum_of_all_its_rewards() -> None:
    trips = Trips(1, 2)
    found = step(trips, (1.0, 10.0), red=True)
    assert found["trips"] == 0
    assert np.isnan(found["trip_return"])
    step(trips, (2.0, 20.0))
    found = step(trips, (4.0, 40.0), "a-")
    assert (found["trips"], found["trip_return"], found["success"]) == (1, 7.0, 1.0)
    assert found["red_light"] == 1.0
    found = step(trips, (8.0, 80.0), "aa")
    # The second trip of the first agent has the return 8, the trip of the second agent has 150.
    assert found["trip_return"] == pytest.approx((7.0 + 8.0 + 150.0) / 3.0)
    assert found["red_light"] == pytest.approx(1.0 / 3.0)


def test_truncated_trips_do_not_count() -> None:
    trips = Trips(1, 2)
    step(trips, (100.0, 1.0), red=True)
    assert step(trips, (100.0, 1.0), "c-")["trips"] == 0
    found = step(trips, (3.0, 1.0), "a-")
    assert (found["trips"], found["trip_return"], found["red_light"]) == (1, 3.0, 0.0)


def test_loaded_trips_continue_with_their_returns() -> None:
    trips, again = Trips(1, 2), Trips(1, 2)
    step(trips, (1.0, 5.0), "-a")
    again.load(trips.save())
    found = step(again, (2.0, 0.0), "a-")
    assert (found["trips"], found["trip_return"]) == (2, 4.0)
