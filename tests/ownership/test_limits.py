"""Impossible limits are refused; tallies of owned vehicles and sets of used ids are correct."""

from __future__ import annotations

from typing import Any

import pytest

from cavmarl.core.errors import ConfigError, ProtocolError
from cavmarl.ownership.distances import Distances
from cavmarl.ownership.ledger import OwnedTally, SeenIds, tally
from cavmarl.ownership.limits import Limits
from tests.support.lossy_network import Rates

RUN = bytes(range(16))


@pytest.mark.parametrize(
    ("change", "why"), [({"deferral": -1}, "deferral = -1"), ({"attempts": 0}, "attempts = 0")]
)
def test_impossible_deadlines_are_refused(change: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        Limits(**change)


def test_impossible_distances_are_refused() -> None:
    with pytest.raises(ConfigError, match="distance below 0"):
        Distances(approach_m=-1.0, hysteresis_m=0.0, overlap_m=10.0)
    with pytest.raises(ConfigError, match="must be wider"):
        Distances(approach_m=10.0, hysteresis_m=0.0, overlap_m=10.0)


def test_a_rate_above_1_is_refused() -> None:
    with pytest.raises(ConfigError, match="rate of drop is 2"):
        Rates(drop=2.0)


def test_a_tally_depends_only_on_its_run_and_vehicles() -> None:
    whole = tally(RUN, {7: 0, 8: 3, 9: 1})
    assert whole == OwnedTally().plus(RUN, 9, 1).plus(RUN, 7, 0).plus(RUN, 8, 3)
    assert whole.minus(RUN, 8, 3) == tally(RUN, {7: 0, 9: 1})
    assert tally(RUN, {7: 1}) != tally(RUN, {7: 0}) != tally(bytes(16), {7: 0})
    with pytest.raises(ProtocolError, match="2 vehicles instead of 3"):
        whole.check(whole.minus(RUN, 8, 3), "here")


def test_a_set_of_consecutive_ids_stores_only_its_upper_end() -> None:
    seen = SeenIds()
    for block in range(0, 1000, 10):
        for vehicle in reversed(range(block, block + 10)):
            assert vehicle not in seen
            seen.add(vehicle)
            assert vehicle in seen
    assert (seen.floor, seen.above) == (1000, set())
