"""`SumoTraffic`: SUMO's part in a tick of W worlds, in one place however they are divided.

`sumo-traffic`: SUMO moves its vehicles, which are rows here, and sees ours. Each side that moves a
vehicle from tick t to t + 1 has seen all others at t: ours move first, for
that needs nothing but t; then SUMO takes its step and is told where ours have come to.

`sumo-demand`: SUMO runs the demand by itself. A vehicle that departs there is ordered here at the
same tick, with its type, route, stops, lane and speed factor; one rerouted there is rerouted here;
its signals are ours.
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
from cavmarl.core.records.codes import COUNT_REROUTED, LANE_GIVEN, POS_GIVEN, SPEED_MAX
from cavmarl.roads.network import SIGNAL_STATES, RoadNetwork
from cavmarl.traffic.kernels.mirroring import greet, list_others, mirror, send_on
from cavmarl.traffic.sumo.route_book import RouteBook, StopBook
from cavmarl.traffic.sumo.sumo_demand import SumoDemand
from cavmarl.traffic.sumo.sumo_history import MOVED, ToldLog
from cavmarl.traffic.sumo.sumo_worlds import SumoWorlds


class _Shown(NamedTuple):
    """What a world's signals have shown the last time."""

    letters: NDArray[np.uint8]  # codes of characters, of all signals one after the other
    phase: NDArray[np.int32]  # (num_signals,) PHASE rows


class ShownSignals:
    """Finds the phase of each signal that shows the same letters.

    `network`: the roads, with all programs that SUMO has.
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

        `letters`: of all signals, one after the other. `phase`: (num_signals,) is written.

        Raises SumoError: a signal shows what no program of the map's has.
        """
        codes, last = np.frombuffer(letters, dtype=np.uint8), self._last[w]
        if last is None:
            changed, rows = np.arange(len(self._parts)), np.zeros(len(self._parts), dtype=np.int32)
        else:  # most of them show what they have shown in the tick before
            changed, rows = np.unique(self._signal_of[codes != last.letters]), last.phase
        for signal in changed.tolist():
            part = letters[self._parts[signal]]
            row = self._rows.get((signal, part))
            if row is None:
                self._last[w] = None
                raise SumoError(
                    f"signal '{self._ids[signal]}' shows '{part.decode()}', which no "
                    "phase of its programs does: give all of its programs as <tlLogic> in the map "
                    "or in an additional file of the demand"
                )
            rows[signal] = row
        self._last[w] = _Shown(codes, rows)
        phase[:] = rows


class SumoTraffic:
    """SUMO beside W worlds.

    `travel`: types and ways, with room for its routes behind. `first_step`: where that room begins.
    `zoned`: the rows of all zones. `blank`: VEHICLE (1,), the record that every vehicle starts
    from.

    Attributes:
        drives: whether SUMO moves its vehicles.
        worlds: its worlds.
    """

    def __init__(
        self,
        demand: SumoDemand,
        network: RoadNetwork,
        travel: TripTables,
        first_step: int,
        zoned: ZoneState,
        blank: NDArray[np.void],
    ) -> None:
        self.drives = demand.drives
        num_worlds, capacity = zoned.rows.shape[2:]
        book = RouteBook(network, travel.steps, first_step, num_worlds, travel.types["permissions"])
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
        self._others = np.zeros(capacity, dtype=zoned.rows.dtype)
        lanes, links = network.lanes, network.links
        leads_to = np.where(lanes["internal"], links["to_lane"][lanes["link"]], -1)
        self._edge_of_lane = np.where(
            lanes["internal"], lanes["edge"][leads_to], lanes["edge"]
        ).astype(np.int32)

    def reset(self, chosen: NDArray[np.bool_], worlds: Worlds) -> None:
        """Start SUMO anew in the chosen worlds (W,); errors as of `SumoWorlds.begin`."""
        for w in np.flatnonzero(chosen).tolist():
            self.worlds.begin(w, int(worlds.keys[w]))

    def keep_logs(self) -> tuple[ToldLog, ...]:
        """From the next reset on keep what SUMO is told, one log a world, for `catch_up`.

        There is none where SUMO moves no vehicle: then it is told nothing.
        """
        if self.drives and not self.worlds.logs:
            num_worlds = self._zoned.rows.shape[2]
            self.worlds.logs = tuple(ToldLog(self._replay_bytes) for _ in range(num_worlds))
        return self.worlds.logs

    def catch_up(self, worlds: Worlds) -> None:
        """Bring SUMO to the worlds' ticks, from the beginning of their episodes.

        Raises SumoError: SUMO has been told where ours are, and that is not on record.
        """
        for w, (key, tick) in enumerate(zip(worlds.keys, worlds.ticks.tolist(), strict=True)):
            told: Iterable[NDArray[np.void]] = repeat(np.zeros(0, dtype=MOVED), tick)
            if self.drives:
                log = self.worlds.logs[w] if self.worlds.logs else ToldLog(0)
                told = log.ticks(tick)
            self.worlds.begin(w, int(key))
            for passed, moved in enumerate(told):
                self.worlds.step_one(w, passed, moved)

    def step(self, worlds: Worlds, side: int) -> None:
        """Let SUMO take its step; errors as of `SumoWorlds.step`.

        `worlds`: of any shard. `side`: where the next rows are.
        """
        self.worlds.step(worlds.ticks.tolist(), lambda w: self._moved(w, side))

    def mirror(self, worlds: Worlds, side: int) -> int:
        """Bring SUMO's vehicles to where they are after its step; arguments as of `step`.

        Returns how many vehicles leave, in all worlds.
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

    def forgive(self, departures: DepartureQueue) -> None:
        """Mark the leaving vehicles that have not arrived but been lifted off the road."""
        for w, num in enumerate(departures.num_passing.tolist()):
            leaving = departures.passing[w, :num]
            lifted = np.isin(leaving["order"], self.worlds.at(w).teleported)
            leaving["events"][lifted] = 0

    def let_in(
        self, departures: DepartureQueue, worlds: Worlds, running: NDArray[np.int64]
    ) -> bool:
        """Fill `departures.passing` with the vehicles that SUMO has let in; whether there are any.

        `running`: (W,) vehicles that are in each world.

        Raises CapacityError: more than there is room for.
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
        """Put the vehicles that SUMO has let in at the end of the queue, with routes of theirs.

        Raises CapacityError: more wait than there is room for.
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
        """Give our vehicles, driving and waiting, the routes that SUMO has changed."""
        for w in range(len(worlds.ticks)):
            now, paths = self.worlds.at(w), self.worlds.paths(w)
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

    def show(self, worlds: Worlds) -> None:
        """Let the signals of all worlds show what SUMO's do."""
        for w, phase in enumerate(worlds.signal_phase):
            self._shown.show(w, self.worlds.at(w).letters, phase)

    def shift(self, rows: NDArray[np.void], worlds: int) -> None:
        """Let rows of a world, VEHICLE or departures, be those of so many worlds later.

        Their ways and stops are written, which stand in another part of the tables there.
        """
        self.worlds.book.shift(rows, worlds)
        self.worlds.stops.shift(rows, worlds)

    def close(self) -> None:
        self.worlds.close()

    def _moved(self, w: int, side: int) -> NDArray[np.void]:
        """MOVED (n,) by rising ids: our vehicles as SUMO is to see them."""
        if not self.drives:
            return np.zeros(0, dtype=MOVED)
        num = self._list_others(self._zoned, side, w, self._others)
        ours = self._others[:num]
        ours = ours[np.argsort(ours["id"])]
        moved = np.zeros(num, dtype=MOVED)
        half = 0.5 * ours["length"]
        moved["id"] = ours["id"]
        moved["x"] = ours["x"] + half * cos_all(ours["heading"])
        moved["y"] = ours["y"] + half * sin_all(ours["heading"])
        moved["angle"] = np.degrees(0.5 * math.pi - ours["heading"]) % 360.0
        moved["edge"] = self._edge_of_lane[ours["lane"]]
        moved["kind"] = ours["vtype"]
        return moved

    def _fill(self, row: np.void, seen: np.void, w: int) -> None:
        """Where, in what and by which route a vehicle departs."""
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
        """The way from a lane on a path, from the `at`-th edge on."""
        paths = self.worlds.paths(w)
        part = slice(int(paths.first[path]) + at, int(paths.first[path + 1]))
        places = np.flatnonzero(paths.edges[part] == self._edge_of_lane[lane])
        return int(paths.ways[part][places[0]]) if len(places) else paths.nowhere

    def _check_room(self, wanted: int) -> None:
        if wanted > len(self._others):
            raise CapacityError(
                f"SUMO's demand needs room for {wanted} vehicles, the world has {len(self._others)}"
                ": raise sumo.max_vehicles"
            )
