"""`Rerouting`: vehicles of the demand that search for another route while the world runs.

Three mechanisms reroute vehicles. Vehicles react once to each change of lanes by the caller. SUMO's
rerouting device searches for the fastest route by the speeds of the last minutes. <rerouter>s act
on vehicles that drive on their edges. All mechanisms run once a second. Like the departure queue,
they run in one place even if the world is divided. Decision 011 gives the reasons.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.rng import STREAM_REROUTER, uniform
from cavmarl.core.records import record
from cavmarl.core.records.arrays import DepartureQueue, RoadArrays, TripTables, Worlds
from cavmarl.core.records.codes import COUNT_REROUTED
from cavmarl.driving.kernels.motion.motion import STANDING_MPS
from cavmarl.roads.routing import PLAN
from cavmarl.traffic.demand import Choices
from cavmarl.traffic.demand.rerouters import KEEP_DESTINATION
from cavmarl.traffic.kernels.way_requests import (
    find_asking,
    limit_speeds,
    mark_slots,
    sample_speeds,
)
from cavmarl.traffic.schedule import Schedule
from cavmarl.traffic.way_search import Traffic, WaySearch, WaySearchResult, WaySlots

NEVER = np.iinfo(np.int64).max

# Rerouting state of an ordered vehicle; its row is VEHICLE["order"].
LOOK = record(
    ("next", np.int64),  # tick of the next search
    ("period", np.int64),  # ticks between searches; 0: no repetition
    ("goal", np.int32),  # EDGE row of the destination
    ("seen", np.int32),  # EDGE row at which the vehicle last asked the rerouters
    ("may_leave", np.bool_),  # whether no edge between the first and the last is prescribed
    ("reacted", np.int64),  # tick of the last change of lanes to which it has reacted; -1: none
    ("equipped", np.bool_),  # whether the vehicle has a rerouting device, and so knows the speeds
)


class Rerouting:
    """Rerouting of the vehicles of W worlds: measured speeds, searches, and found routes.

    `travel`: types and routes, with room for more routes at the end. `slots`: that room.
    `first_type`: VTYPE row of the file's first type. `changed_at`: (W,) the tick in which lanes
    last changed. `avoids`: the vehicles that react to such changes, see `population.reroute`.
    """

    def __init__(
        self,
        schedule: Schedule,
        travel: TripTables,
        slots: WaySlots,
        first_type: int,
        dt: float,
        *,
        changed_at: NDArray[np.int64],
        avoids: str,
    ) -> None:
        self._changed_at = changed_at
        self._avoids = avoids
        self._roads: RoadArrays = schedule.demand.network.arrays
        self._travel = travel
        self._slots = slots
        self._schedule = schedule
        self._first_type = first_type
        self._dt = dt
        self._ticks_per_s = max(1, round(1.0 / dt))
        demand, edges, lanes = schedule.demand, len(self._roads.edges), len(self._roads.lanes)
        self._measures = demand.may_look
        steps = demand.device.adaptation_steps if self._measures else 0
        self._past = np.zeros((slots.num_worlds, steps, edges), dtype=np.int32)
        self._speed_sums = np.zeros((slots.num_worlds, edges), dtype=np.int64)
        self._looks = np.zeros((slots.num_worlds, 0), dtype=LOOK)
        self._num_looks = np.zeros(slots.num_worlds, dtype=np.int64)
        rules = demand.rerouters.rules
        self._rules_at = {edge: rules[rules["edge"] == edge] for edge in np.unique(rules["edge"])}
        self._has_rules = np.zeros(edges, dtype=np.bool_)
        self._has_rules[rules["edge"]] = True
        self._lane_counts = np.zeros(lanes, dtype=np.int64)
        self._lane_sums = np.zeros(lanes, dtype=np.int64)

    def begin(self, world: int, key: int, horizon_s: float) -> None:
        """Reset a world's state for its next episode.

        `key`: random key of the world and episode. `horizon_s`: length of an episode in s.
        """
        orders = self._schedule.orders(key, horizon_s)
        more = len(orders) - self._looks.shape[1]
        if more > 0:
            room = np.zeros((len(self._looks), more), dtype=LOOK)
            self._looks = np.concatenate([self._looks, room], axis=1)
        looks = self._looks[world, : len(orders)]
        self._num_looks[world] = len(orders)
        period = np.round(orders["reroute_period_ms"] / 1000.0 / self._dt).astype(np.int64)
        looks["period"] = np.where(period > 0, np.maximum(period, self._ticks_per_s), 0)
        looks["equipped"] = orders["reroute"]
        looks["next"] = np.where(orders["reroute"], 0, NEVER)
        looks["goal"] = self._schedule.last_edges(orders["route"])
        looks["seen"] = -1
        looks["reacted"] = -1
        routes = self._schedule.demand.routes[orders["route"]]
        looks["may_leave"] = routes["exact"] | (routes["num_edges"] <= 2)
        first = self._slots.first_of(world)
        self._travel.steps[first : first + self._slots.of_world] = np.zeros((), dtype=PLAN)
        if self._measures:
            limit_speeds(self._roads, self._past[world], self._speed_sums[world])

    def act(self, departures: DepartureQueue, worlds: Worlds) -> None:
        """Once a second, sample speeds and let vehicles search for routes; write `next_rows`."""
        for w, tick in enumerate(worlds.ticks):
            if tick % self._ticks_per_s == 0:
                self._sample(worlds, w, int(tick))
                departures.counts[w, COUNT_REROUTED] += self._let_ask(worlds, w, int(tick))

    def state(self, world: int, rows: NDArray[np.void]) -> Iterator[NDArray[np.generic]]:
        """Yield the part of a world's state that is kept here, as arrays without padding.

        `rows`: VEHICLE (n,) of the world; only the routes of these vehicles are included.
        """
        yield self._speed_sums[world]
        yield self._past[world]
        unused = {"reacted"} if self._avoids == "never" else set()
        yield from _plain(self._looks[world, : self._num_looks[world]], unused)
        slots = self._slots
        used = np.zeros(slots.number, dtype=np.bool_)
        first = slots.first_of(world)
        mark_slots(self._roads, rows, len(rows), first, slots.steps, used)
        steps = self._travel.steps[first : first + slots.of_world]
        yield from _plain(steps.reshape(slots.number, slots.steps)[used])

    def arrays(self) -> Iterator[NDArray[np.generic]]:
        """Yield all arrays that a tick may change, of all worlds, for saving and restoring."""
        yield from (self._past, self._speed_sums, self._looks)
        yield self._travel.steps[self._slots.first :]

    def arrays_of(self, world: int) -> Iterator[NDArray[np.generic]]:
        """Yield the part of `arrays` that belongs to one world."""
        for array in (self._past, self._speed_sums, self._looks):
            yield array[world : world + 1]
        first = self._slots.first_of(world)
        yield self._travel.steps[first : first + self._slots.of_world]

    def _sample(self, worlds: Worlds, w: int, tick: int) -> None:
        interval_ms = self._schedule.demand.device.adaptation_interval_ms
        ticks = self._ticks_per_s * (interval_ms // 1000)
        if self._measures and tick % ticks == 0:
            sample_speeds(
                self._roads,
                worlds.next_rows[w],
                worlds.num_owned[w],
                tick // ticks,
                self._past[w],
                self._speed_sums[w],
                self._lane_counts,
                self._lane_sums,
            )

    def _let_ask(self, worlds: Worlds, w: int, tick: int) -> int:
        rows, num = worlds.next_rows[w], int(worlds.num_owned[w])
        looks = self._looks[w]
        clock_s = self._travel.begin_s + tick * self._dt
        self._forget_seen(looks, clock_s)
        asking = np.empty(num, dtype=np.int64)
        changed_at = -1 if self._avoids == "never" else int(self._changed_at[w])
        found = find_asking(
            self._roads, rows, num, tick, self._has_rules, looks, changed_at, asking
        )
        if found == 0:
            return 0
        lanes = worlds.lanes[1 + w if len(worlds.lanes) > 1 else 0]
        closed = self._closed(clock_s)
        traffic = Traffic(self._speed_sums[w], self._past.shape[1], closed, lanes)
        search = WaySearch(self._roads, self._travel, self._slots, w, rows, num, traffic)
        legs = rows["leg"][:num].sum()
        for i in asking[:found]:
            row = rows[i]
            look = looks[row["order"]]
            if look["reacted"] < changed_at:
                self._react(search, int(i), row, look, changed_at)
            self._ask_rerouters(search, int(i), row, look, clock_s)
            if tick >= look["next"]:
                answer = search.send(int(i), int(look["goal"]), True, False)
                if answer is not WaySearchResult.LATER:
                    look["next"] = tick + look["period"] if look["period"] > 0 else NEVER
        return int(rows["leg"][:num].sum() - legs)

    def _forget_seen(self, looks: NDArray[np.void], clock_s: float) -> None:
        """Let vehicles ask rerouters again if a rule on their edge began in the last second."""
        rules = self._schedule.demand.rerouters.rules
        before_s = clock_s - self._ticks_per_s * self._dt
        begun = (rules["begin_s"] <= clock_s) & (before_s < rules["begin_s"])
        if begun.any():
            looks["seen"][np.isin(looks["seen"], rules["edge"][begun])] = -1

    def _closed(self, clock_s: float) -> NDArray[np.int64]:
        """Return the bits of the vehicle classes to which each edge (num_edges,) is closed."""
        closed = np.zeros(len(self._roads.edges), dtype=np.int64)
        closings = self._schedule.demand.rerouters.closings
        now = closings[(closings["begin_s"] <= clock_s) & (clock_s < closings["end_s"])]
        np.bitwise_or.at(closed, now["edge"], now["classes"])
        return closed

    def _react(
        self, search: WaySearch, i: int, row: np.void, look: np.void, changed_at: int
    ) -> None:
        """Let a vehicle search for another route after a change of lanes.

        Without another route, it keeps its present route and waits before the closed lane.
        """
        is_blocked = search.meets_closing(i)
        if is_blocked or self._avoids == "always":
            stands = is_blocked and bool(row["speed"] < STANDING_MPS)
            knows = bool(look["equipped"])
            answer = search.send(i, int(look["goal"]), knows, is_blocked, stands)
            if answer is WaySearchResult.LATER:
                return
        look["reacted"] = changed_at

    def _ask_rerouters(
        self, search: WaySearch, i: int, row: np.void, look: np.void, clock_s: float
    ) -> None:
        """Take the route of the first rule on the vehicle's edge that gives another route."""
        edge = self._roads.lanes[row["lane"]]["edge"]
        if look["seen"] == edge:
            return
        rules = self._rules_at[edge]
        for rule in rules[(rules["begin_s"] <= clock_s) & (clock_s < rules["end_s"])]:
            if self._is_meant(rule, row):
                answer = self._follow(search, i, row, look, rule)
                if answer is WaySearchResult.LATER:
                    return
                if answer is WaySearchResult.TAKEN:
                    break
        look["seen"] = edge

    def _is_meant(self, rule: np.void, row: np.void) -> bool:
        """Return whether a rule applies to the vehicle's type and the vehicle follows it."""
        types = self._schedule.demand.rerouters.types[rule["interval"]]
        if not types[row["vtype"] - self._first_type]:
            return False
        return self._drawn(rule, row, 0) < float(rule["chance"])

    def _drawn(self, rule: np.void, row: np.void, number: int) -> float:
        """Return a random number in [0, 1) that is constant until the vehicle's route changes."""
        stream = STREAM_REROUTER + 2 * int(rule["interval"]) + number
        return uniform(row["rng_key"], row["id"], row["leg"], stream)

    def _follow(
        self, search: WaySearch, i: int, row: np.void, look: np.void, rule: np.void
    ) -> WaySearchResult:
        if rule["routes"] >= 0:
            return self._take_route(search, i, row, look, rule)
        knows = bool(look["equipped"])
        if rule["closes"]:
            if not search.meets_closing(i):
                return WaySearchResult.KEPT
            answer = search.send(i, int(look["goal"]), knows, True)
            if answer is not WaySearchResult.NO_WAY or rule["goals"] < 0:
                return answer
        goal = self._pick(self._schedule.demand.rerouters.goals, rule["goals"], rule, row)
        if goal in (KEEP_DESTINATION, look["goal"]):
            return WaySearchResult.KEPT
        answer = search.send(i, goal, knows, True)
        if answer is WaySearchResult.TAKEN:
            look["goal"] = goal
            # The detour plans do not lead to the new goal.
            row["goal"] = -1
        return answer

    def _take_route(
        self, search: WaySearch, i: int, row: np.void, look: np.void, rule: np.void
    ) -> WaySearchResult:
        schedule = self._schedule
        route = self._pick(schedule.demand.rerouters.routes, rule["routes"], rule, row)
        vtype = int(row["vtype"]) - self._first_type
        way = schedule.way_on(route, vtype, int(self._roads.lanes[row["lane"]]["edge"]))
        answer = search.send_along(i, way) if way >= 0 else WaySearchResult.NO_WAY
        if answer is WaySearchResult.TAKEN:
            look["goal"] = schedule.last_edges(np.array([route]))[0]
            row["goal"] = schedule.detour_goal(route, vtype)
        return answer

    def _pick(self, choices: Choices, number: int, rule: np.void, row: np.void) -> int:
        drawn = np.array([self._drawn(rule, row, 1)])
        return int(choices.pick(np.array([number], dtype=np.int32), drawn)[0])


def _plain(
    records: NDArray[np.void], unused: Collection[str] = ()
) -> Iterator[NDArray[np.generic]]:
    """Yield the fields of records one by one, without padding and unused fields."""
    for name in records.dtype.names or ():
        if name not in unused:
            yield np.ascontiguousarray(records[name])
