"""Room for the ways that vehicles find while the world runs: slots behind the table of all ways."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import CapacityError
from cavmarl.roads.routing import PLAN
from cavmarl.traffic.schedule import MAX_STEPS, Schedule

LEAST_STEPS = 128  # of a slot, if the map has so many lanes
DETOUR_RATIO = 3  # a way may take this many times the steps of the longest known one


@dataclass(frozen=True)
class WaySlots:
    """Where the slots lie; they are never more, whatever an episode brings."""

    first: int  # PLAN row of the first world's first slot
    number: int  # slots of one world
    steps: int  # of one slot
    num_worlds: int  # how many worlds have slots
    # of the map. So many unused steps before the first slot keep the ways in slots above all
    # others: a way is a step's row minus that of a lane.
    num_lanes: int

    def table(self) -> NDArray[np.void]:
        """PLAN, all steps of all slots, to be put behind the others."""
        return np.zeros(self.num_lanes + self.num_worlds * self.of_world, dtype=PLAN)

    @property
    def of_world(self) -> int:
        """Steps of one world's slots."""
        return self.number * self.steps

    def first_of(self, world: int) -> int:
        """PLAN row of a world's first slot."""
        return self.first + world * self.of_world

    def ways_of_first_world(self, ways: NDArray[np.int64], world: int) -> NDArray[np.int64]:
        """VEHICLE["way"] (n,) of a world as it would be in the first one: where slots play no part.

        `world`: in which they are.
        """
        own = ways >= self.first - self.num_lanes
        return ways - own * (world * self.of_world)


def way_slots(
    schedule: Schedule, first_step: int, num_worlds: int, capacity: int, horizon_s: float
) -> WaySlots:
    """The slots of a demand: one for each vehicle that may need one at a time.

    `first_step`: how many PLAN rows come before. `capacity`: vehicles of one world. `horizon_s`:
    seconds an episode.

    Raises:
        CapacityError: they would take more than `MAX_STEPS`.
    """
    number = capacity
    if not len(schedule.demand.rerouters.rules):
        # With a device only: how many have it is drawn.
        equipped = int(schedule.orders(0, horizon_s)["reroute"].sum())
        number = min(capacity, equipped + 6 * math.isqrt(equipped) + 16)
    num_lanes = len(schedule.demand.network.lanes)
    outside = int((~schedule.demand.network.lanes["internal"]).sum())
    steps = min(outside, max(LEAST_STEPS, DETOUR_RATIO * schedule.longest))
    if num_worlds * number * steps > MAX_STEPS:
        raise CapacityError(
            f"ways of {number} vehicles that look for their own, {steps} steps each, in "
            f"{num_worlds} worlds are over {MAX_STEPS} steps: fewer worlds, or fewer vehicles "
            "with a rerouting device"
        )
    return WaySlots(first_step + num_lanes, number, steps, num_worlds, num_lanes)
