"""`SumoTraffic`: SUMO's part of a tick of W worlds, in one place even if worlds are divided.

With `sumo-traffic`, SUMO moves its vehicles, which are rows here, and sees the vehicles of this
package. Both sides compute the state at tick t + 1 from the state at t. This package moves its
vehicles first; then SUMO receives their new positions and takes its step.

With `sumo-demand`, SUMO runs the demand by itself. A vehicle that departs in SUMO is ordered here
at the same tick, with its type, route, stops, lane and speed factor. A vehicle that SUMO reroutes
is also rerouted here. Signals show SUMO's phases.

If lanes change, SUMO receives the changes before its step, in which they also apply here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import accumulate, pairwise, repeat
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.core.errors import CapacityError, SumoError
from cavmarl.core.math.elementary_arrays import cos_all, sin_all
from cavmarl.core.records.arrays import DepartureQueue, RoadArrays, TripTables, Worlds, ZoneState
from cavmarl.core.records.codes import (
    COUNT_REROUTED,
    DRIVER_BACKGROUND,
    DRIVER_EXTERNAL,
    LANE_GIVEN,
    POS_GIVEN,
    SPEED_MAX,
)
from cavmarl.driving.kernels.motion.motion import STANDING_MPS
from cavmarl.roads.network import SIGNAL_STATES, RoadNetwork
from cavmarl.traffic.kernels.mirroring import find_blocked, greet, list_others, mirror, send_on
from cavmarl.traffic.kernels.way_requests import has_room, put_on_way
from cavmarl.traffic.sumo.route_book import RouteBook, StopBook
from cavmarl.traffic.sumo.sumo_demand import SumoDemand
from cavmarl.traffic.sumo.sumo_history import MOVED, ToldLog
from cavmarl.traffic.sumo.sumo_lanes import SumoLanes
from cavmarl.traffic.sumo.sumo_worlds import SumoWorlds


class _Shown(NamedTuple):
    """The last state of a world's signals."""

    letters: NDArray[np.uint8]  # letters of all signals, one signal after the other
    phase: NDArray[np.int32]  # (num_signals,) PHASE rows


class ShownSignals:
    """Finds the phase of each signal from the letters that it shows.

    `network`: the roads, with all programs of SUMO.
    """

    def __init__(self, network: RoadNetwork, num_worlds: int) -> None:
        self._ids = network.signal_ids
        num_letters = network.signals["num_links"]
        self._signal_of = np.repeat(np.arange(len(num_letters)), num_letters)
        self._last: list[_Shown | None] = [None] * num_worlds
        bounds = accumulate(network.signals["num_links"].tolist(), initial=0)
        self._parts = [slice(*pair) for pair in pairwise(bounds)]
        self._rows: dict[tuple[int, bytes], int] = {}
        for program in network.programs:
            signal = int(program["signal"])
            num = int(network.signals[signal]["num_links"])
            first = int(program["first_phase"])
            for row in range(first, first + int(program["num_phases"])):
                state = int(network.phases[row]["first_state"])
                codes = network.phase_states[state : state + num]
                letters = "".join(SIGNAL_STATES[code] for code in codes).encode()
                self._rows.setdefault((signal, letters), row)

    def show(self, w: int, letters: bytes, phase: NDArray[np.int32]) -> None:
        """Write the PHASE rows of a world's signals.

        `letters`: letters of all signals, one signal after the other. `phase`: (num_signals,),
        written.

        Raises SumoError: a signal shows letters that no program of the map has.
        """
        codes, last = np.frombuffer(letters, dtype=np.uint8), self._last[w]
        if last is None:
            changed, rows = np.arange(len(self._parts)), np.zeros(len(self._parts), dtype=np.int32)
        else:  # most signals show the same letters as in the previous tick
            changed, rows = np.unique(self._signal_of[codes != last.letters]), last.phase
        for signal in changed.tolist():
            part = letters[self._parts[signal]]
            row = self._rows.get((signal, part))
            if row is None:
                self._last[w] = None
                raise SumoError(
                    f"signal '{self._ids[signal]}' shows '{part.decode()}', which is not a "
                    "phase of its programs; give all of its programs as <tlLogic> in the map "
                    "or in an additional file of the demand"
                )
            rows[signal] = row
        self._last[w] = _Shown(codes, rows)
        phase[:] = rows


class SumoTraffic:
    """The simulations of SUMO for W worlds.

    `travel`: types and routes, with room for SUMO's routes at the end. `first_step`: start of that
    room. `zoned`: the rows of all zones. `blank`: VEHICLE (1,), template of every vehicle's record.
    `lanes`: LANE (W, L) of each world; (0, L): lanes do not change. `plan_steps`: see `RouteBook`.

    Attributes:
        drives: whether SUMO moves its vehicles.
        worlds: SUMO's worlds.
    """

    def __init__(
        self,
        demand: SumoDemand,
        network: RoadNetwork,
        travel: TripTables,
        first_step: int,
        zoned: ZoneState,
        blank: NDArray[np.void],
        lanes: NDArray[np.void],
        plan_steps: int = 0,
    ) -> None:
        self.drives = demand.drives
        self._num_callers = demand.num_callers
        num_worlds, capacity = zoned.rows.shape[2:]
        permissions = travel.types["permissions"]
        book = RouteBook(network, travel.steps, first_step, num_worlds, permissions, plan_steps)
        stops = StopBook(network, travel.stops, num_worlds)
        self.worlds = SumoWorlds(demand, book, stops, num_worlds)
        self._roads: RoadArrays = network.arrays
        self._travel = travel
        self._zoned = zoned
        self._blank = blank
        self._dt = demand.dt_s
        self._replay_bytes = demand.replay_bytes
        self._shown = ShownSignals(network, num_worlds)
        self._mirror = specialized(mirror)
        self._greet = specialized(greet)
        self._list_others = specialized(list_others)
        self._send_on = specialized(send_on)
        self._find_blocked = specialized(find_blocked)
        self._others = np.zeros(capacity, dtype=zoned.rows.dtype)
        on_map, links = network.lanes, network.links
        leads_to = np.where(on_map["internal"], links["to_lane"][on_map["link"]], -1)
        self._edge_of_lane = np.where(
            on_map["internal"], on_map["edge"][leads_to], on_map["edge"]
        ).astype(np.int32)
        self._lanes = SumoLanes(on_map, lanes)
        self._reroutes = demand.reroutes not in ("", "never")
        self._ticks_per_s = max(1, round(1.0 / demand.dt_s))

    def reset(self, chosen: NDArray[np.bool_], worlds: Worlds) -> None:
        """Restart SUMO in the chosen worlds (W,); errors as in `SumoWorlds.begin`."""
        for w in np.flatnonzero(chosen).tolist():
            self._begin(w, int(worlds.keys[w]))

    def _begin(self, w: int, key: int) -> None:
        self.worlds.begin(w, key)
        self._lanes.begin(w)

    def keep_logs(self) -> tuple[ToldLog, ...]:
        """Log what SUMO receives after the next reset, one log per world, for `catch_up`.

        Returns the logs; empty if SUMO moves no vehicles and lanes do not change.
        """
        if self._tells and not self.worlds.logs:
            num_worlds = self._zoned.rows.shape[2]
            self.worlds.logs = tuple(ToldLog(self._replay_bytes) for _ in range(num_worlds))
        return self.worlds.logs

    @property
    def _tells(self) -> bool:
        """Whether SUMO receives anything during an episode; see `EnvConfig.tells_sumo`."""
        return self.drives or len(self._lanes.now) > 0

    def catch_up(self, worlds: Worlds) -> None:
        """Run SUMO from the beginning of the episodes to the worlds' ticks.

        Raises SumoError: what SUMO received in these ticks is not recorded.
        """
        for w, (key, tick) in enumerate(zip(worlds.keys, worlds.ticks.tolist(), strict=True)):
            logged: Iterable[NDArray[np.void]] = repeat(np.zeros(0, dtype=MOVED), tick)
            if self._tells:
                log = self.worlds.logs[w] if self.worlds.logs else ToldLog(0)
                logged = log.ticks(tick)
            self._begin(w, int(key))
            for passed, moved in enumerate(logged):
                self._lanes.learn(w, moved)
                self.worlds.step_one(w, passed, moved)

    def step(self, worlds: Worlds, side: int) -> None:
        """Let SUMO take its step; errors as in `SumoWorlds.step`.

        `worlds`: the worlds of any shard. `side`: half of `ZoneState.rows` with the next rows.
        """
        ticks = worlds.ticks.tolist()
        self.worlds.step(ticks, lambda w: self._told(w, side, ticks[w]))

    def _told(self, w: int, side: int, tick: int) -> NDArray[np.void]:
        """Return MOVED (n,): everything that the SUMO of a world receives before its step."""
        lanes = self._lanes.news(w)
        if self.drives:
            return np.concatenate([lanes, self._moved(w, side)])
        asks = self._reroutes and tick % self._ticks_per_s == 0
        return np.concatenate([lanes, self._asking(w, side)]) if asks else lanes

    def _asking(self, w: int, side: int) -> NDArray[np.void]:
        """Return MOVED (n,) by ascending id: vehicles whose routes lead over closed roads.

        SUMO's own copies of these vehicles may have passed the road before it was closed.
        """
        if not self._lanes.has_closed(w):
            return np.zeros(0, dtype=MOVED)
        num = self._find_blocked(
            self._roads, self._travel, self._lanes.now[w], self._zoned, side, w, self._others
        )
        ours = np.sort(self._others[:num], order="id")
        asking = np.zeros(num, dtype=MOVED)
        asking["id"], asking["kind"] = ours["order"], ours["vtype"]
        asking["edge"] = self._edge_of_lane[ours["lane"]]
        return asking

    def mirror(self, worlds: Worlds, side: int) -> int:
        """Move SUMO's vehicles to their positions after its step; arguments as in `step`.

        Returns the number of vehicles that leave, in all worlds.
        """
        return sum(
            self._mirror(
                self._roads,
                self._travel,
                self.worlds.paths(w),
                self.worlds.at(w).seen,
                self._zoned,
                side,
                w,
                self._dt,
            )
            for w in range(len(worlds.ticks))
        )

    @property
    def people(self) -> list[NDArray[np.void]]:
        """SEEN (p,) of each world: the persons on foot."""
        return [self.worlds.at(w).people for w in range(self._zoned.rows.shape[2])]

    def forgive(self, departures: DepartureQueue) -> None:
        """Clear the events of vehicles that SUMO has teleported: they leave without arriving."""
        for w, num in enumerate(departures.num_passing.tolist()):
            leaving = departures.passing[w, :num]
            lifted = np.isin(leaving["order"], self.worlds.at(w).teleported)
            leaving["events"][lifted] = 0

    def let_in(
        self, departures: DepartureQueue, worlds: Worlds, running: NDArray[np.int64]
    ) -> bool:
        """Fill `departures.passing` with vehicles that SUMO has inserted; return whether any have.

        `running`: (W,) vehicles in each world.

        Raises CapacityError: a world has too few rows.
        """
        for w in range(len(worlds.ticks)):
            now = self.worlds.at(w)
            if not len(now.departed):
                continue
            self._check_room(running.item(w) + len(now.departed))
            self._greet(
                self._roads,
                self._travel,
                self.worlds.paths(w),
                now.seen,
                now.departed,
                now.speed_factors,
                self._blank,
                departures,
                w,
                int(worlds.ticks[w]),
                worlds.keys[w],
            )
        return bool(departures.num_passing.any())

    def order(self, departures: DepartureQueue, worlds: Worlds) -> None:
        """Queue the vehicles that SUMO has inserted, with their routes.

        Raises CapacityError: the queue has too little room.
        """
        for w in range(len(worlds.ticks)):
            now = self.worlds.at(w)
            come = zip(now.departed.tolist(), now.speed_factors, now.stops, strict=True)
            for number, factor, stops in come:
                if departures.num_queue[w] == departures.queue.shape[1]:
                    self._check_room(departures.queue.shape[1] + 1)
                row = departures.queue[w, departures.num_queue[w]]
                self._fill(row, now.seen[np.searchsorted(now.seen["number"], number)], w)
                row["id"] = departures.next_id[w]
                row["due"] = worlds.ticks[w] + 1
                row["speed_factor"] = factor
                row["stop"], row["stops_end"] = stops
                departures.next_id[w] += 1
                departures.num_queue[w] += 1

    def send_on(self, departures: DepartureQueue, worlds: Worlds, side: int) -> None:
        """Put this package's vehicles, driving or waiting, on the routes that SUMO has changed."""
        for w in range(len(worlds.ticks)):
            now, paths = self.worlds.at(w), self.worlds.paths(w)
            if len(now.ways):
                departures.counts[w, COUNT_REROUTED] += self._take_ways(w, side, now.ways)
            if not len(now.rerouted):
                continue
            places = np.searchsorted(now.seen["number"], now.rerouted)
            chosen = now.seen["route"][places].astype(np.int64)
            departures.counts[w, COUNT_REROUTED] += self._send_on(
                self._roads, paths, now.rerouted, chosen, self._zoned, side, w
            )
            waiting = departures.queue[w, : departures.num_queue[w]]
            for n in np.flatnonzero(np.isin(waiting["order"], now.rerouted)):
                row = waiting[n]
                path = int(chosen[np.searchsorted(now.rerouted, row["order"])])
                row["way"] = self._way(w, path, 0, int(row["lane"]))

    def _take_ways(self, w: int, side: int, ways: NDArray[np.int64]) -> int:
        """Put vehicles on the routes that they have asked for, if they have room to turn off.

        `ways`: (k, 2) VEHICLE["order"] and path. Returns the number of vehicles on a new route.
        """
        taken = 0
        chosen = dict(ways.tolist())
        for zone, num in enumerate(self._zoned.num_owned[:, w].tolist()):
            rows = self._zoned.rows[side, zone, w, :num]
            asked = np.isin(rows["order"], ways[:, 0]) & (rows["driver"] == DRIVER_BACKGROUND)
            for i in np.flatnonzero(asked).tolist():
                row = rows[i]
                way = self._way(w, chosen[int(row["order"])], 0, int(row["lane"]))
                stands = row["speed"] < STANDING_MPS
                if stands or has_room(self._roads, self._travel, row, self._travel.steps, way):
                    put_on_way(self._travel, row, way)
                    taken += 1
        return taken

    def show(self, worlds: Worlds) -> None:
        """Show the signal phases of SUMO in all worlds."""
        for w, phase in enumerate(worlds.signal_phase):
            self._shown.show(w, self.worlds.at(w).letters, phase)

    def single(self, rows: NDArray[np.void], w: int) -> None:
        """Convert rows of world w, VEHICLE or departures, to rows of an environment with one world.

        Only `way` and stops change, because each world has its own part of their tables.
        """
        self.worlds.book.single(rows, w)
        self.worlds.stops.shift(rows, -w)

    def placed(self, rows: NDArray[np.void], w: int) -> None:
        """Convert rows back to rows of world w; see `single`."""
        self.worlds.book.placed(rows, w)
        self.worlds.stops.shift(rows, w)

    def close(self) -> None:
        self.worlds.close()

    def _moved(self, w: int, side: int) -> NDArray[np.void]:
        """Return MOVED (n,) by ascending id: the vehicles that SUMO does not move."""
        num = self._list_others(self._zoned, side, w, self._others)
        ours = self._others[:num]
        is_person = (ours["driver"] == DRIVER_EXTERNAL) & (ours["order"] >= self._num_callers)
        ours = ours[~is_person]
        ours = ours[np.argsort(ours["id"])]
        moved = np.zeros(len(ours), dtype=MOVED)
        half = 0.5 * ours["length"]
        moved["id"] = ours["id"]
        moved["x"] = ours["x"] + half * cos_all(ours["heading"])
        moved["y"] = ours["y"] + half * sin_all(ours["heading"])
        moved["angle"] = np.degrees(0.5 * math.pi - ours["heading"]) % 360.0
        moved["edge"] = self._edge_of_lane[ours["lane"]]
        moved["kind"] = ours["vtype"]
        moved["length"], moved["width"] = ours["length"], ours["width"]
        return moved

    def _fill(self, row: np.void, seen: np.void, w: int) -> None:
        """Write the place, type and route of a departing vehicle."""
        lane = int(seen["lane"])
        edge = self._roads.edges[self._roads.lanes[lane]["edge"]]
        row["agent"] = row["goal"] = -1
        row["order"] = seen["number"]
        row["vtype"] = seen["vtype"]
        row["lane"] = lane
        row["lane_code"], row["pos_code"], row["speed_code"] = LANE_GIVEN, POS_GIVEN, SPEED_MAX
        row["pos"] = seen["pos"] * self._roads.lanes[lane]["length_m"] / edge["length_m"]
        row["way"] = self._way(w, int(seen["route"]), int(seen["at"]), lane)

    def _way(self, w: int, path: int, at: int, lane: int) -> int:
        """Return VEHICLE["way"] from a lane along a path, starting at the path's `at`-th edge."""
        paths = self.worlds.paths(w)
        part = slice(int(paths.first[path]) + at, int(paths.first[path + 1]))
        places = np.flatnonzero(paths.edges[part] == self._edge_of_lane[lane])
        return int(paths.ways[part][places[0]]) if len(places) else paths.nowhere

    def _check_room(self, wanted: int) -> None:
        if wanted > len(self._others):
            raise CapacityError(
                f"SUMO's demand needs {wanted} rows for vehicles, the world has {len(self._others)}"
                "; raise sumo.max_vehicles"
            )
