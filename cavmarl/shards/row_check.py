"""Checks of vehicle rows from outside before kernels use their indices.

Rows come from saved states, from states that nodes keep, and from vehicles that change their zone.
Kernels use their indices into the tables of the network and of the routes without bounds checks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import RoadArrays
from cavmarl.core.records.codes import (
    AUTHORITATIVE,
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    DRIVER_EXTERNAL,
    DRIVER_LEARNED,
    DRIVER_SUMO,
    HOLD_EXIT_BLOCKED,
)
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.traffic.native import NativeTraffic

Mask = NDArray[np.bool_]
Numbers = NDArray[np.int64]

LEAST_FACTOR = 1e-6  # minimum factor of desired speeds, since slower vehicles never arrive
_LARGEST = 1e12  # limit of all numbers in metres or seconds
_ENDLESS = ("to_go", "step_to_go")  # fields that are infinite without a route
_LEAST = dict.fromkeys(("s", "wait_s", "stopped_s", "distance_m", "free_s", "step_jerk"), 0.0)
_LEAST |= {"speed_factor": LEAST_FACTOR}
_FLOATS = tuple(name for name in VEHICLE.names or () if VEHICLE[name].kind == "f")
_INT32 = tuple(name for name in VEHICLE.names or () if VEHICLE[name] == np.int32)
MOST = int(np.iinfo(np.int32).max)
MOST_IDS = 1 << 62  # limit of the ids of vehicles in a run


class ColumnCheck:
    """A check of the columns of records with an `id`.

    Args:
        ints: allowed ranges of integer columns.
        floats: columns of floating-point numbers, in metres, seconds or radians.
        endless: columns of `floats` that may be infinite.
        least: minimum of some columns of `floats`.
    """

    def __init__(
        self,
        ints: Mapping[str, range],
        floats: Sequence[str],
        endless: Sequence[str],
        least: Mapping[str, float],
    ) -> None:
        self._ints, self._floats = tuple(ints), tuple(floats)
        self._low = np.array([allowed.start for allowed in ints.values()])
        self._high = np.array([allowed.stop - 1 for allowed in ints.values()])
        self._endless = [self._floats.index(name) for name in endless]
        self._least = np.array([least.get(name, -np.inf) for name in floats])

    def wrong(self, rows: NDArray[np.void]) -> str:
        """Return what is wrong with a number of one of the rows; empty if nothing."""
        ints = np.stack([rows[name] for name in self._ints], axis=1)
        outside = (ints < self._low) | (ints > self._high)
        if outside.any():
            row, column = np.argwhere(outside)[0].tolist()
            low, high = self._low.item(column), self._high.item(column)
            return _of(rows[row], self._ints[column], f"is not in {low} to {high}")
        floats = np.stack([rows[name] for name in self._floats], axis=1)
        usual = np.abs(floats) <= _LARGEST
        usual[:, self._endless] |= floats[:, self._endless] == np.inf
        usual &= floats >= self._least
        if usual.all():
            return ""
        row, column = np.argwhere(~usual)[0].tolist()
        return _of(rows[row], self._floats[column], f"is not an allowed number up to ±{_LARGEST:g}")


class RowCheck:
    """A check of the vehicle rows of worlds.

    Args:
        roads: the network.
        traffic: the types and routes of vehicles.
        num_agents: the largest number of agents in an episode of a world.

    Attributes:
        indices: ranges of the fields by which kernels index tables, except `way`.
        steps: number of route steps; the sum of `way` and the lane is the index of a step.
    """

    def __init__(self, roads: RoadArrays, traffic: NativeTraffic, num_agents: int) -> None:
        self._roads = roads
        self._travel = travel = traffic.travel
        none = np.zeros(0, dtype=np.int32)
        self._step_lanes = none if traffic.schedule is None else traffic.schedule.step_lanes
        self._is_moved = traffic.sumo is not None
        self._num_external, self._nowhere = traffic.num_external, traffic.nowhere
        num_lanes, num_links = len(roads.lanes), len(roads.links)
        self._num_lanes = num_lanes
        self._num_goals, self._plan_steps = len(traffic.plans), traffic.plans.size
        self.steps = len(travel.steps)
        self._own_plans = traffic.own_plan_steps
        goals = max(self._num_goals, len(travel.scripts.frames), self.steps // max(num_lanes, 1))
        self.indices = {
            "id": range(MOST_IDS),
            "lane": range(num_lanes),
            "side_lane": range(-1, num_lanes),
            "target_lane": range(-1, num_lanes),
            "link": range(-1, num_links),
            "stopped_at": range(-1, num_links),
            "vtype": range(len(travel.types)),
            "driver": range(DRIVER_BACKGROUND, 1 + self._last_driver()),
            "agent": range(-1, num_agents),
            "goal": range(-1, goals),
            "stop": range(-1, 1 + len(travel.stops)),
            "stops_end": range(-1, 1 + len(travel.stops)),
        }
        values = self.indices | {
            "hold": range(HOLD_EXIT_BLOCKED + 1),
            "blinker": range(-1, 2),
            "leg": range(MOST + 1),
            "order": range(-1, MOST + 1),
            "owner": range(MOST + 1),  # may be a zone of another partition; loading overwrites it
            "epoch": range(MOST + 1),
            "transfer": range(AUTHORITATIVE, AUTHORITATIVE + 1),
        }
        every = range(-MOST - 1, MOST + 1)
        ints = {name: values.get(name, every) for name in _INT32}
        self._columns = ColumnCheck(ints, _FLOATS, _ENDLESS, _LEAST)
        types = travel.types
        self._radius_m = 0.5 * float(diagonals_m(types).max()) + 1e-6
        self._height_m = float(types["height"].max()) + 1e-6

    def _last_driver(self) -> int:
        """Return the largest number of a driver in these worlds."""
        if self._travel.types["network"].any():
            return DRIVER_LEARNED
        return DRIVER_EXTERNAL if self._num_external else DRIVER_SUMO

    def wrong(
        self,
        rows: NDArray[np.void],  # VEHICLE (n,)
        tail: NDArray[np.void] | None = None,  # PLAN (n,) the last n route steps; None: unchanged
        num_orders: int = MOST,  # number of orders in the world's demand
    ) -> str:
        """Return what is wrong with one of these vehicles of one world; empty if nothing."""
        if not len(rows):
            return ""
        rows = np.ascontiguousarray(rows)
        return (
            self._columns.wrong(rows)
            or self._wrong_sizes(rows)
            or self._wrong_goals(rows)
            or self._wrong_identity(rows, num_orders)
            or self._wrong_ways(rows, tail)
        )

    def _wrong_sizes(self, rows: NDArray[np.void]) -> str:
        radii_m = 0.5 * diagonals_m(rows)
        sizes = np.stack([rows["length"], rows["width"], rows["height"]])
        wrong = (sizes <= 0.0).any(axis=0) | (radii_m > self._radius_m)
        wrong |= rows["height"] > self._height_m
        if not wrong.any():
            return ""
        return _of(rows[np.argmax(wrong)], "length", "fits no type with this width and height")

    def _wrong_goals(self, rows: NDArray[np.void]) -> str:
        """Check that `goal` names a plan, a detour or a frame of a script, as the driver needs."""
        travel, driver = self._travel, rows["driver"]
        detours = self._num_goals
        if travel.first_detour:
            detours = (travel.num_fixed - travel.first_detour) // self._num_lanes
        low = np.array([-1, 0, 0, -1, -1, 0])
        plans = self._num_goals
        high = np.array([detours, plans, len(travel.scripts.frames), 0, 0, plans])
        wrong = (rows["goal"] < low[driver]) | (rows["goal"] >= high[driver])
        wrong |= (driver == DRIVER_AGENT) & (rows["agent"] < 0)
        wrong |= (driver == DRIVER_EXTERNAL) & (rows["way"] != self._nowhere)
        wrong |= (driver == DRIVER_EXTERNAL) & (self._num_external == 0)
        networks = travel.types["network"][rows["vtype"]]
        is_other = (networks == 0) | (rows["agent"] >= 0) | (rows["order"] >= 0)
        wrong |= (driver == DRIVER_LEARNED) & is_other
        wrong |= rows["stop"] > rows["stops_end"]
        if not wrong.any():
            return ""
        return _of(rows[np.argmax(wrong)], "goal", "does not fit its driver, order, agent or stop")

    def _wrong_identity(self, rows: NDArray[np.void], num_orders: int) -> str:
        for name, numbers in (
            ("id", rows["id"]),
            ("agent", rows["agent"][rows["agent"] >= 0]),
        ):
            if len(np.unique(numbers)) < len(numbers):
                return f"two vehicles have the same {name}"
        is_external = rows["driver"] == DRIVER_EXTERNAL
        end = np.where(is_external, self._num_external, num_orders)
        wrong = (rows["id"] < 0) | (rows["tick"] < 0) | (rows["order"] >= end)
        wrong |= is_external & (rows["order"] < 0)
        stood_lane = np.where(rows["lane_stood"] < 0, 0, rows["lane_stood"] >> 32)
        wrong |= (rows["lane_stood"] < -1) | (stood_lane >= self._num_lanes)
        if not wrong.any():
            return ""
        problem = "is invalid, or the vehicle's id, tick or lane_stood is invalid"
        return _of(rows[np.argmax(wrong)], "order", problem)

    def _wrong_ways(self, rows: NDArray[np.void], tail: NDArray[np.void] | None) -> str:
        """Check that routes are valid; follow those whose first step may belong to another lane."""
        lane, way = self._own_lanes(rows["lane"]), rows["way"]
        at = way + lane
        if wrong := self._wrong_places(rows, lane, way):
            return wrong
        travel, lanes = self._travel, self._num_lanes
        planned = (at < self._plan_steps) & (at % lanes == lane)
        if travel.first_detour:
            of_routes = (at >= self._plan_steps) & (at < travel.first_detour)
            planned[of_routes] = (
                self._step_lanes[at[of_routes] - self._plan_steps] == lane[of_routes]
            )
            behind = at - travel.first_detour
            planned |= (behind >= 0) & (at < travel.num_fixed) & (behind % lanes == lane)
        of_world = at - self._own_plans.start
        planned |= (
            (at >= self._own_plans.start) & (at < self._own_plans.stop) & (of_world % lanes == lane)
        )
        drives = np.isin(rows["driver"], (DRIVER_BACKGROUND, DRIVER_AGENT, DRIVER_LEARNED))
        follow = drives & ~planned
        if self._is_moved:  # SUMO sends the routes again after loading
            follow &= at < travel.num_fixed
        rows, lane, way = rows[follow], lane[follow], way[follow]
        past_way, past_lane, num_steps = way, lane, 0
        while len(rows):
            if num_steps & (num_steps - 1) == 0:
                past_way, past_lane = way, lane
            num_steps += 1
            step = self._steps(way + lane, tail)
            goes_on = step["next"] >= 0
            rows, step, way = rows[goes_on], step[goes_on], way[goes_on] + step["shift"][goes_on]
            if (step["next"] >= lanes).any():
                return _of(rows[np.argmax(step["next"] >= lanes)], "way", "leads to no lane")
            lane = self._own_lanes(step["next"])
            if wrong := self._wrong_places(rows, lane, way):
                return wrong
            past_way, past_lane = past_way[goes_on], past_lane[goes_on]
            repeats = (way == past_way) & (lane == past_lane)
            if repeats.any():
                return _of(rows[np.argmax(repeats)], "way", "does not end")
        return ""

    def _steps(self, at: Numbers, tail: NDArray[np.void] | None) -> NDArray[np.void]:
        steps = self._travel.steps
        found = steps[at]
        if tail is not None:
            first = len(steps) - len(tail)
            found[at >= first] = tail[at[at >= first] - first]
        return found

    def _wrong_places(self, rows: NDArray[np.void], lane: Numbers, way: Numbers) -> str:
        """Check that all lanes of the edges have steps: a vehicle may change to any of them."""
        edges = self._roads.edges[self._roads.lanes["edge"][lane]]
        first = way + edges["first_lane"]
        wrong = (first < 0) | (first + edges["num_lanes"] > len(self._travel.steps))
        wrong |= (way < -MOST) | (way > MOST)  # the sums above may have overflowed
        return _of(rows[np.argmax(wrong)], "way", "leads out of all routes") if wrong.any() else ""

    def _own_lanes(self, lane: NDArray[np.int32]) -> Numbers:
        """Return the lanes whose steps apply: for a lane inside a junction, the lane after it."""
        lanes = self._roads.lanes
        behind = self._roads.links["to_lane"][lanes["link"][lane]]
        return np.where(lanes["internal"][lane], behind, lane).astype(np.int64)


def diagonals_m(bodies: NDArray[np.void]) -> NDArray[np.float64]:
    """Return the diagonals (n,) in m of records with a length and a width, seen from above."""
    length, width = bodies["length"].astype(np.float64), bodies["width"].astype(np.float64)
    return np.asarray(np.sqrt(length * length + width * width), dtype=np.float64)


def _of(row: np.void, name: str, problem: str) -> str:
    return f"vehicle {int(row['id'])} has {name} = {row[name].item()}, which {problem}"
