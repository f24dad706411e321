"""`SumoWorlds`: a simulation of SUMO for each of W worlds, tick by tick.

Each simulation has its own process and seed. A repeated tick gets the stored answer, so no SUMO
takes a step twice.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, SumoError
from cavmarl.traffic.kernels.mirroring import Paths
from cavmarl.traffic.sumo.route_book import RouteBook, StopBook
from cavmarl.traffic.sumo.sumo_demand import SumoDemand
from cavmarl.traffic.sumo.sumo_history import ToldLog
from cavmarl.traffic.sumo.sumo_process import SumoAnswer, SumoProcess

SEED_BITS = 31

log = logging.getLogger(__name__)


class SumoTick(NamedTuple):
    """The state that SUMO reports for one tick of one world."""

    tick: int  # tick of this state
    seen: NDArray[np.void]  # SEEN (n,) by ascending number; the route field holds paths
    letters: bytes  # letters of all signals
    departed: NDArray[np.int64]  # (m,) numbers of vehicles that have entered, ascending
    speed_factors: NDArray[np.float64]  # (m,) speed factors of the departed vehicles
    # (m, 2) STOP rows [first, end) of their stops, -1: none; (0, 2) if SUMO moves the vehicles
    stops: NDArray[np.int64]
    teleported: tuple[int, ...]  # numbers of teleported vehicles
    rerouted: NDArray[np.int64]  # (r,) numbers of vehicles with a changed route, ascending
    people: NDArray[np.void]  # SEEN (p,) persons on foot, by slot
    ways: NDArray[np.int64]  # (k, 2) numbers of vehicles that have asked for a route, and paths


class SumoWorlds:
    """The SUMO processes and their last answers.

    `book`: receives the vehicles' routes. `stops`: receives their stops.

    Attributes:
        book: the vehicles' routes.
        stops: the vehicles' stops.
        names: for each world, SUMO's names of the vehicles by number.
        teleports: (W,) number of vehicles that SUMO has teleported since each reset.
        dropped: (W,) number of vehicles that SUMO has dropped before departure since each reset.
        logs: for each world, what SUMO has received since its reset; empty: no logs.
    """

    def __init__(
        self, demand: SumoDemand, book: RouteBook, stops: StopBook, num_worlds: int
    ) -> None:
        self.book = book
        self.stops = stops
        self.names: list[list[str]] = [[] for _ in range(num_worlds)]
        self.teleports = np.zeros(num_worlds, dtype=np.int64)
        self.dropped = np.zeros(num_worlds, dtype=np.int64)
        self.logs: tuple[ToldLog, ...] = ()
        self._demand = demand
        self._tick_ms = round(1000.0 * demand.dt_s)
        self._begin_ms = round(1000.0 * demand.given.begin_s)
        self._processes: list[SumoProcess | None] = [None] * num_worlds
        self._ticks: list[SumoTick | None] = [None] * num_worlds
        self._has_warned = [False] * num_worlds  # of missing slots for persons, in this episode
        self._path_of = [np.zeros(0, dtype=np.int32) for _ in range(num_worlds)]

    @property
    def pids(self) -> tuple[int, ...]:
        return tuple(p.pid for p in self._processes if p is not None and p.is_alive)

    def begin(self, w: int, key: int) -> None:
        """Restart a world's SUMO for an episode.

        `key`: root of the random numbers.

        Raises ConfigError: SUMO refuses its files; SumoError: the process ended.
        """
        process = self._processes[w]
        if process is None or not process.is_alive:
            process = self._processes[w] = SumoProcess(self._demand.setup())
        self._ticks[w] = None
        self.book.begin(w)
        self.stops.begin(w)
        self.names[w] = []
        self._has_warned[w] = False
        self.teleports[w] = self.dropped[w] = 0
        if self.logs:
            self.logs[w].begin()
        self._path_of[w] = np.zeros(0, dtype=np.int32)
        seed = key >> (64 - SEED_BITS)
        # SUMO reads all additional files when it starts.
        with tempfile.TemporaryDirectory(prefix="cavmarl-sumo-") as folder:
            answer = process.start(self._demand.words(Path(folder), seed))
        self._ticks[w] = self._take(w, 0, answer)

    def at(self, w: int) -> SumoTick:
        """Return the state of a world's present tick."""
        tick = self._ticks[w]
        if tick is None:
            raise SumoError("the process of SUMO has ended; reset the world to continue")
        return tick

    def paths(self, w: int) -> Paths:
        return self.book.paths(w)

    def step(self, ticks: Sequence[int], moved: Callable[[int], NDArray[np.void]]) -> None:
        """Let the SUMOs of all worlds take a step, in parallel.

        Args:
            ticks: (W,) since the reset, before the step.
            moved: returns MOVED (n,), what the SUMO of a world receives before the step.

        Raises:
            SumoError: a process has ended, so that its world has to be reset; or a world and its
                SUMO are at different ticks.
        """
        asked = []
        for w, tick in enumerate(ticks):
            last = self.at(w)
            if last.tick == tick + 1:  # a repeated tick
                continue
            if last.tick != tick:
                raise SumoError(
                    f"world {w} is at tick {tick}, its SUMO at tick {last.tick}; reset the world"
                )
            asked.append(w)
        places = {}
        try:
            for w in asked:
                places[w] = moved(w)
                self._process(w).begin_step(places[w])
            for w in asked:
                self._ticks[w] = self._take(w, ticks[w] + 1, self._process(w).end_step())
                self._note(w, places[w])
        except (SumoError, ConfigError) as error:
            # Other SUMOs may have taken the step, but their worlds have not.
            for w in asked:
                self._ticks[w] = None
            raise SumoError(f"world {w}: {error}") from error

    def step_one(self, w: int, tick: int, moved: NDArray[np.void]) -> None:
        """Let the SUMO of one world take a step from a tick; errors as in `step`."""
        process = self._process(w)
        process.begin_step(moved)
        self._ticks[w] = self._take(w, tick + 1, process.end_step())
        self._note(w, moved)

    def _note(self, w: int, moved: NDArray[np.void]) -> None:
        if self.logs:
            self.logs[w].note(moved)

    def close(self) -> None:
        for process in self._processes:
            if process is not None:
                process.close()

    def _process(self, w: int) -> SumoProcess:
        process = self._processes[w]
        if process is None:
            raise SumoError("SUMO has not been started; reset the world first")
        return process

    def _take(self, w: int, tick: int, answer: SumoAnswer) -> SumoTick:
        line, seen = answer.line, answer.seen
        should_be = self._begin_ms + tick * self._tick_ms
        if line["time_ms"] != should_be:
            raise SumoError(
                f"world {w}: SUMO's clock shows {line['time_ms']} ms instead of {should_be} ms"
            )
        people, seen = seen[seen["number"] < 0], seen[seen["number"] >= 0]
        if "unseen" in line and not self._has_warned[w]:
            self._has_warned[w] = True
            log.warning(
                "world %d, tick %d: %d persons of SUMO are not mirrored; raise sumo.max_persons",
                w, tick, line["unseen"],
            )  # fmt: skip
        self.book.enter(w, line.get("routes", []))
        seen["route"] = self.book.look_up(w, seen["route"], seen["vtype"])
        departed = line.get("departed", [])
        self.names[w] += [name for _, name, _, _ in departed]
        stops = [self.stops.enter(w, stops) for *_, stops in departed]
        lifted = line.get("teleported", [])
        for number, name in lifted:
            log.warning("world %d, tick %d: SUMO teleports %s (%d)", w, tick, name, number)
        self.teleports[w] += len(lifted)
        if dropped := line.get("dropped", []):
            self.dropped[w] += len(dropped)
            log.warning(
                "world %d, tick %d: SUMO drops %s (%d in this episode) before departure: the first "
                "road is closed, or max-depart-delay has passed",
                w, tick, ", ".join(dropped), self.dropped[w],
            )  # fmt: skip
        ways = np.array(line.get("ways", []), dtype=np.int32).reshape(-1, 3)
        ways[:, 1] = self.book.look_up(w, ways[:, 1], ways[:, 2])
        return SumoTick(
            tick,
            seen,
            answer.letters,
            np.array([number for number, *_ in departed], dtype=np.int64),
            np.array([factor for _, _, factor, _ in departed], dtype=np.float64),
            np.array(stops, dtype=np.int64).reshape(-1, 2),
            tuple(number for number, _ in lifted),
            self._changed(w, seen),
            people,
            ways[:, :2].astype(np.int64),
        )

    def _changed(self, w: int, seen: NDArray[np.void]) -> NDArray[np.int64]:
        numbers = seen["number"]
        missing = len(self.names[w]) - len(self._path_of[w])
        known = np.append(self._path_of[w], np.full(missing, -1, dtype=np.int32))
        self._path_of[w] = known
        is_other = (known[numbers] >= 0) & (known[numbers] != seen["route"])
        known[numbers] = seen["route"]
        changed: NDArray[np.int64] = numbers[is_other].astype(np.int64)
        return changed
