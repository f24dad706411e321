"""Visit all states of small worlds: in each state, the invariants hold and the end can be reached.

The worlds have one vehicle in three zones, or two vehicles in two zones. Messages may be late,
doubled or lost. Hosts of source, target and other zones, and the coordinator, may die at any time.
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
    "1 vehicle, 2 zones, every process dies": Small(
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
def test_the_invariants_hold_in_every_state_and_each_state_can_reach_the_end(small: Small) -> None:
    states, reached = Explorer(small).run()
    assert states == reached > 300


@pytest.mark.slow
@pytest.mark.parametrize("small", SLOW.values(), ids=SLOW)
def test_the_invariants_hold_in_every_state_of_larger_worlds_and_each_can_reach_the_end(
    small: Small,
) -> None:
    states, reached = Explorer(small).run()
    assert states == reached > 300
