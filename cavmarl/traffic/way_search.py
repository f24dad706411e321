"""`WaySearch`: searches for routes in a world at one second, using the traffic known then.

Found routes are stored in slots behind the table of the steps of all other routes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import CapacityError
from cavmarl.core.records.arrays import RoadArrays, TripTables
from cavmarl.roads.kernels.plans import plan_goal
from cavmarl.roads.routing import PLAN
from cavmarl.traffic.kernels.way_requests import (
    CLOSED_S,
    find_way,
    has_room,
    mark_slots,
    put_on_way,
    slow_lanes,
    take_slot,
    time_left,
)
from cavmarl.traffic.lane_plans import SHUT_S
from cavmarl.traffic.schedule import MAX_STEPS, Schedule

LEAST_STEPS = 128  # minimum size of a slot, if the map has at least as many lanes
PREFERENCE = 1.2  # factor by which contraflow lanes seem faster to some vehicles
DETOUR_RATIO = 3  # a found route may have this many times the steps of the longest known route


@dataclass(frozen=True)
class WaySlots:
    """Layout of the slots; the number of slots is fixed for all episodes."""

    first: int  # PLAN row of the first world's first slot
    number: int  # slots per world
    steps: int  # number of steps per slot
    num_worlds: int  # number of worlds with slots
    # number of lanes of the map; this many unused steps precede the first slot. VEHICLE["way"] is
    # the row of a step minus the row of a lane, so it is greater in slots than elsewhere.
    num_lanes: int

    @property
    def room(self) -> int:
        """Number of PLAN rows to append to the table."""
        return self.num_lanes + self.num_worlds * self.of_world

    @property
    def of_world(self) -> int:
        """Number of steps in all slots of one world."""
        return self.number * self.steps

    def first_of(self, world: int) -> int:
        """Return the PLAN row of a world's first slot."""
        return self.first + world * self.of_world

    def ways_of_first_world(self, ways: NDArray[np.int64], world: int) -> NDArray[np.int64]:
        """Convert VEHICLE["way"] (n,) of a world to the values in world 0.

        `world`: the world of `ways`. Values outside the slots do not change.
        """
        own = ways >= self.first - self.num_lanes
        return ways - own * (world * self.of_world)


def seekers(schedule: Schedule, capacity: int, horizon_s: float) -> int:
    """Return the maximum number of rerouting vehicles in a world at the same time.

    `capacity`: number of vehicles of one world. `horizon_s`: length of an episode in s.
    """
    if len(schedule.demand.rerouters.rules):
        return capacity
    # Without rerouters, only equipped vehicles search; their number is random.
    equipped = int(schedule.orders(0, horizon_s)["reroute"].sum())
    return min(capacity, equipped + 6 * math.isqrt(equipped) + 16)


def way_slots(
    lanes: NDArray[np.void],  # LANE of the map
    longest: int,  # number of steps of the longest known route
    first_step: int,  # number of PLAN rows before the slots
    num_worlds: int,
    number: int,  # slots per world
) -> WaySlots:
    """Return slots for the routes of `number` vehicles per world.

    Raises CapacityError: the slots would take more than `MAX_STEPS`.
    """
    num_lanes = len(lanes)
    outside = int((~lanes["internal"]).sum())
    steps = min(outside, max(LEAST_STEPS, DETOUR_RATIO * longest))
    if num_worlds * number * steps > MAX_STEPS:
        raise CapacityError(
            f"{num_worlds} worlds, {number} vehicles each that may search for a route, {steps} "
            f"steps per route: over {MAX_STEPS} steps; use fewer worlds, fewer vehicles with a "
            "rerouting device, or give trips their routes (duarouter)"
        )
    return WaySlots(first_step + num_lanes, number, steps, num_worlds, num_lanes)


class WaySearchResult(Enum):
    """The result of a search for a route."""

    KEPT = 0  # the present route is as fast
    TAKEN = 1
    LATER = 2  # the vehicle can no longer turn off here; it searches again in a second
    NO_WAY = 3


class Traffic(NamedTuple):
    """The known traffic of one world."""

    speed_sums: NDArray[np.int64]  # (num_edges,) mm/s, see `sample_speeds`
    samples: int  # number of samples in each sum
    closed: NDArray[np.int64]  # (num_edges,) bits of the classes that may not use an edge
    lanes: NDArray[np.void]  # LANE (L,) with the present limits and permissions


class WaySearch:
    """Searches for routes of a world's vehicles. Each plan is made at its first use.

    `travel`: types and routes; found routes are written to the slots. `slots`: layout of the slots.
    `rows`: VEHICLE of the world.
    """

    def __init__(
        self,
        roads: RoadArrays,
        travel: TripTables,
        slots: WaySlots,
        world: int,
        rows: NDArray[np.void],
        num: int,
        traffic: Traffic,
    ) -> None:
        self._roads = roads
        self._travel = travel
        self._slot_steps = slots.steps
        self._first_slot = slots.first_of(world)
        self._rows = rows
        self._traffic = traffic
        self._contraflow = roads.lanes["permissions"] == 0
        self._speeds: dict[tuple[int, bool, bool], RoadArrays] = {}
        self._plans: dict[tuple[int, int, bool, bool], NDArray[np.void]] = {}
        self._used = np.zeros(slots.number, dtype=np.bool_)
        mark_slots(roads, rows, num, self._first_slot, slots.steps, self._used)
        self._edges = np.zeros(slots.steps, dtype=np.int32)
        self._steps = np.zeros(slots.steps, dtype=PLAN)
        self._cost = np.zeros(slots.steps)

    def meets_closing(self, i: int) -> bool:
        """Return whether the route of row i leads over a lane that is closed to the vehicle."""
        row = self._rows[i]
        permission = self._permission(i)
        roads = self._roads_now(permission, False, False)
        time: float = time_left(roads, self._travel.steps, row["way"], row["lane"])
        return CLOSED_S <= time - self._own_s(roads, row, permission) < np.inf

    def _own_s(self, roads: RoadArrays, row: np.void, permission: int) -> float:
        """Return the time in s on the vehicle's present lane if the caller has closed it, else 0.

        Plans add a long wait for closed lanes, but a vehicle that is on a closed lane drives on.
        """
        lane = int(row["lane"])
        if int(self._traffic.lanes["permissions"][lane]) & permission:
            return 0.0
        return float(roads.lanes["length_m"][lane] / roads.lanes["speed_mps"][lane])

    def send(
        self, i: int, goal: int, knows: bool, anyhow: bool, stands: bool = False
    ) -> WaySearchResult:
        """Put row i on the fastest route to a goal if it is faster than the present route.

        `i`: row of a vehicle outside junctions. `knows`: whether it knows the measured speeds;
        otherwise the limits are used. All vehicles know closures. `anyhow`: whether to leave the
        present route even for a slower route. `stands`: whether the vehicle is stopped, so that it
        needs no room to brake before a lane change.
        """
        row = self._rows[i]
        permission = self._permission(i)
        prefers = self._prefers_contraflow(row)
        roads = self._roads_now(permission, knows, prefers)
        plan = self._plan(goal, permission, knows, prefers)
        lane = int(row["lane"])
        number = find_way(roads, plan, lane, permission, self._edges, self._steps, self._cost)
        way = -int(self._roads.edges[self._roads.lanes[lane]["edge"]]["first_lane"])
        if number == 0:
            return WaySearchResult.NO_WAY
        time = time_left(roads, self._steps, way, lane)
        if time - self._own_s(roads, row, permission) >= CLOSED_S:
            return WaySearchResult.NO_WAY
        if not anyhow and time >= time_left(roads, self._travel.steps, row["way"], lane):
            return WaySearchResult.KEPT
        if not (stands or has_room(self._roads, self._travel, row, self._steps, way)):
            return WaySearchResult.LATER
        found = self._steps[:number]
        taken = take_slot(
            self._roads, self._travel, row, found, self._first_slot, self._slot_steps, self._used
        )
        return WaySearchResult.TAKEN if taken else WaySearchResult.NO_WAY

    def send_along(self, i: int, way: int) -> WaySearchResult:
        row = self._rows[i]
        if way == row["way"]:
            return WaySearchResult.KEPT
        if not self._travel.steps[way + row["lane"]]["to_go"] < np.inf:
            return WaySearchResult.NO_WAY
        if not has_room(self._roads, self._travel, row, self._travel.steps, way):
            return WaySearchResult.LATER
        put_on_way(self._travel, row, way)
        return WaySearchResult.TAKEN

    def _permission(self, i: int) -> int:
        return int(self._travel.types[self._rows[i]["vtype"]]["permissions"])

    def _prefers_contraflow(self, row: np.void) -> bool:
        """Return whether a vehicle takes contraflow lanes if both routes are about equally fast.

        Every second vehicle does. Otherwise all vehicles would stay on the road beside the
        contraflow lanes until it is slow.
        """
        return bool(self._contraflow.any()) and int(row["id"]) % 2 == 0

    def _roads_now(self, permission: int, knows: bool, prefers: bool) -> RoadArrays:
        """Return the roads with the speeds that a class can expect as speed limits."""
        key = permission, knows, prefers
        if key not in self._speeds:
            lanes = self._roads.lanes.copy()
            samples = self._traffic.samples if knows else 0
            slow_lanes(
                self._roads, self._traffic.speed_sums, samples, self._traffic.closed,
                self._traffic.lanes, permission, lanes,
            )  # fmt: skip
            contraflow = self._contraflow
            lanes["permissions"][contraflow] = permission
            shut = contraflow & (self._traffic.lanes["permissions"] & permission == 0)
            lanes["speed_mps"][shut] = lanes["length_m"][shut] / SHUT_S
            if prefers:
                lanes["speed_mps"][contraflow & ~shut] *= PREFERENCE
            # Lanes are immutable like the roads, because kernels are compiled for immutable lanes.
            lanes.setflags(write=False)
            self._speeds[key] = self._roads._replace(lanes=lanes)
        return self._speeds[key]

    def _plan(self, goal: int, permission: int, knows: bool, prefers: bool) -> NDArray[np.void]:
        key = goal, permission, knows, prefers
        if key not in self._plans:
            plan = np.zeros(len(self._roads.lanes), dtype=PLAN)
            roads = self._roads_now(permission, knows, prefers)
            plan_goal(roads, goal, permission, 1.0, plan)
            self._plans[key] = plan
        return self._plans[key]
