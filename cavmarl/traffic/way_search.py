"""`WaySearch`: ways through one world in one second, by what is known of its traffic then."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import RoadArrays, Travel
from cavmarl.roads.kernels.plans import plan_goal
from cavmarl.roads.routing import PLAN
from cavmarl.traffic.kernels.edge_speeds import CLOSED_S, slow_lanes
from cavmarl.traffic.kernels.way_requests import (
    find_way,
    has_room,
    mark_slots,
    put_on_way,
    take_slot,
    time_left,
)
from cavmarl.traffic.way_slots import WaySlots


class WaySearchResult(Enum):
    """What came of looking for a way."""

    KEPT = 0  # the present way is as fast
    TAKEN = 1
    LATER = 2  # the vehicle cannot turn off any more here: it asks again in a second
    NO_WAY = 3


class Traffic(NamedTuple):
    """What is known of one world's traffic."""

    speed_sums: NDArray[np.int64]  # (num_edges,) mm/s, see `kernels.edge_speeds`
    samples: int  # how many a sum has
    closed: NDArray[np.int64]  # (num_edges,) bits of the classes that an edge is closed to


class WaySearch:
    """Ways of one world's vehicles. Plans are made where they are asked for, each once.

    `travel`: types and ways; new ones are written into the slots. `slots`: where those are. `rows`:
    VEHICLE, the world's.
    """

    def __init__(
        self,
        roads: RoadArrays,
        travel: Travel,
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
        self._speeds: dict[tuple[int, bool], RoadArrays] = {}
        self._plans: dict[tuple[int, int, bool], NDArray[np.void]] = {}
        self._used = np.zeros(slots.number, dtype=np.bool_)
        mark_slots(roads, rows, num, self._first_slot, slots.steps, self._used)
        self._edges = np.zeros(slots.steps, dtype=np.int32)
        self._steps = np.zeros(slots.steps, dtype=PLAN)
        self._cost = np.zeros(slots.steps)

    def meets_closing(self, i: int) -> bool:
        """Whether the way of row i leads over an edge that is closed to it."""
        row = self._rows[i]
        roads = self._roads_now(self._permission(i), False)
        time: float = time_left(roads, self._travel.steps, row["way"], row["lane"])
        return CLOSED_S <= time < np.inf

    def send(self, i: int, goal: int, knows: bool, anyhow: bool) -> WaySearchResult:
        """Put row i on the fastest way to a goal, if that is faster than its present way.

        `i`: row of a vehicle outside junctions. `knows`: whether it knows the speeds; otherwise the
        limits count. Closings all know. `anyhow`: whether it leaves its present way even for a
        slower one.
        """
        row = self._rows[i]
        permission = self._permission(i)
        roads = self._roads_now(permission, knows)
        plan = self._plan(goal, permission, knows)
        lane = int(row["lane"])
        number = find_way(roads, plan, lane, permission, self._edges, self._steps, self._cost)
        way = -int(self._roads.edges[self._roads.lanes[lane]["edge"]]["first_lane"])
        if number == 0:
            return WaySearchResult.NO_WAY
        time = time_left(roads, self._steps, way, lane)
        if time >= CLOSED_S:
            return WaySearchResult.NO_WAY
        if not anyhow and time >= time_left(roads, self._travel.steps, row["way"], lane):
            return WaySearchResult.KEPT
        if not has_room(self._roads, self._travel, row, self._steps, way):
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

    def _roads_now(self, permission: int, knows: bool) -> RoadArrays:
        """The roads with the speeds that count for a class as speed limits."""
        key = permission, knows
        if key not in self._speeds:
            lanes = self._roads.lanes.copy()
            samples = self._traffic.samples if knows else 0
            slow_lanes(
                self._roads, self._traffic.speed_sums, samples, self._traffic.closed, permission,
                lanes,
            )  # fmt: skip
            # As immutable as the roads themselves: kernels are compiled for such.
            lanes.setflags(write=False)
            self._speeds[key] = self._roads._replace(lanes=lanes)
        return self._speeds[key]

    def _plan(self, goal: int, permission: int, knows: bool) -> NDArray[np.void]:
        key = goal, permission, knows
        if key not in self._plans:
            plan = np.zeros(len(self._roads.lanes), dtype=PLAN)
            plan_goal(self._roads_now(permission, knows), goal, permission, 1.0, plan)
            self._plans[key] = plan
        return self._plans[key]
