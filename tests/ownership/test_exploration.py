"""All states of small worlds: each is correct, and can reach the end.

One vehicle and three zones, two vehicles and two zones, with messages that are late, doubled or
lost, and with deaths of source, target, bystander and coordinator at any moment.
"""

from __future__ import annotations

import pytest

from cavmarl.ownership.limits import Limits
from tests.ownership.explorer import Explorer, Small

QUICK = {
    "1 vehicle, 3 zones, 3 ticks": Small(zones=3, ticks=3),
    "1 vehicle, 3 zones, the coordinator dies": Small(
        zones=3, ticks=3, coordinator_crashes=1, turns_away=False
    ),
    "1 vehicle, 3 zones, a host dies": Small(zones=3, crashes=1),
    "1 vehicle, 3 zones, a zombie": Small(zones=3, false_alarms=1),
    "1 vehicle, 2 zones, 4 ticks, old offers": Small(ticks=4, window=1),
    "1 vehicle, 2 zones, a host dies, 3 ticks": Small(ticks=3, crashes=1, turns_away=False),
    "1 vehicle, 2 zones, a zombie, 3 ticks": Small(ticks=3, false_alarms=1),
    "1 vehicle, 2 zones, everybody dies": Small(
        crashes=1, false_alarms=1, coordinator_crashes=1, turns_away=False
    ),
    "1 vehicle, 2 zones, two hosts die": Small(crashes=2),
    "1 vehicle, 2 zones, no waiting": Small(ticks=3, limits=Limits(deferral=0)),
    "2 vehicles, 2 zones, 3 ticks": Small(vehicles=2, ticks=3),
    "2 vehicles, 2 zones, the coordinator dies": Small(
        vehicles=2, ticks=3, coordinator_crashes=1, turns_away=False
    ),
    "2 vehicles, 2 zones, a host dies": Small(vehicles=2, crashes=1),
    "2 vehicles, 2 zones, a zombie": Small(vehicles=2, false_alarms=1),
}
SLOW = {
    "1 vehicle, 3 zones, a host dies, 3 ticks": Small(
        zones=3, ticks=3, crashes=1, turns_away=False
    ),
    "1 vehicle, 2 zones, host and coordinator die": Small(
        ticks=3, crashes=1, coordinator_crashes=1
    ),
    "1 vehicle, 2 zones, 5 ticks": Small(ticks=5),
    "2 vehicles, 2 zones, a host dies, 3 ticks": Small(
        vehicles=2, ticks=3, crashes=1, turns_away=False
    ),
}


@pytest.mark.parametrize("small", QUICK.values(), ids=QUICK)
def test_every_state_is_correct_and_can_reach_the_end(small: Small) -> None:
    states, reached = Explorer(small).run()
    assert states == reached > 300


@pytest.mark.slow
@pytest.mark.parametrize("small", SLOW.values(), ids=SLOW)
def test_every_state_of_larger_worlds_is_correct_and_can_reach_the_end(small: Small) -> None:
    states, reached = Explorer(small).run()
    assert states == reached > 300
