"""`TrafficLights`: traffic lights whose states and times clients set, and which they can freeze.

A group is the lights of one signal. It runs its program of the map until a client changes a time,
freezes or resets the group. From then on, the group goes through the phases of that program with
the times of the clients. A light whose state a client sets shows it for the light's time of that
state, and then follows its group again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.core.records.codes import SIGNAL_NONE
from cavmarl.cosim.carla.call_arguments import CallRefused
from cavmarl.cosim.carla.carla_map import GREEN, OFF, RED, YELLOW, CarlaMap
from cavmarl.env.parallel import CavEnv
from cavmarl.roads.network import SIGNAL_STATES

TIMED = (GREEN, YELLOW, RED)  # columns of the times of a light
MOST_S = 1e6
_CODE_OF_STATE = {
    RED: SIGNAL_STATES.index("r"),
    YELLOW: SIGNAL_STATES.index("y"),
    GREEN: SIGNAL_STATES.index("G"),
    OFF: SIGNAL_STATES.index("O"),
}
_GREEN_MINOR = SIGNAL_STATES.index("g")


@dataclass
class _Group:
    """The phases of a signal whose times clients set, numbered from the first one of a program."""

    first: int  # PHASE row
    following: list[int]  # next phase of each phase
    durations_s: NDArray[np.float64]  # duration of each phase
    phase: int  # current phase
    elapsed_s: float  # time in the current phase
    is_frozen: bool = False

    def advance(self, step_s: float) -> bool:
        """Advance the time; return whether the phase has changed."""
        self.elapsed_s += step_s
        before = self.phase
        for _ in self.following:
            duration_s = float(self.durations_s[self.phase])
            if self.elapsed_s < duration_s - 0.5 * step_s:
                break
            self.elapsed_s -= duration_s
            self.phase = self.following[self.phase]
        return self.phase != before


@dataclass
class _SetState:
    """A state that a client has set."""

    state: int
    left_s: float  # simulated time until the light follows its group again


class TrafficLights:
    """The traffic lights of the one world of an environment.

    A light is the index of an approach of the map.

    Attributes:
        times_s: (approaches, 3) green, yellow and red time.
        elapsed_s: (approaches,) time since the state of each light has changed.
    """

    def __init__(self, env: CavEnv, carla_map: CarlaMap) -> None:
        self._env, self._map, self._network = env, carla_map, carla_map.network
        self._num_links = int(np.count_nonzero(self._network.links["signal"] >= 0))
        self.forget()

    def forget(self) -> None:
        """Let the programs of the map run, at the start of an episode."""
        number = len(self._map.approaches)
        self._groups: dict[int, _Group] = {}
        self._set: dict[int, _SetState] = {}
        self._seconds: dict[tuple[int, int], float] = {}  # times of clients by light and state
        self._states = np.full(number, OFF, np.uint8)
        self.times_s = self._map.times_s.copy()
        self.elapsed_s = np.zeros(number)

    @property
    def is_frozen(self) -> NDArray[np.bool_]:
        """Whether the time of each light is stopped."""
        frozen = {signal for signal, group in self._groups.items() if group.is_frozen}
        return np.array([one.signal in frozen for one in self._map.approaches], np.bool_)

    def states(self) -> NDArray[np.uint8]:
        """Return the state of each light."""
        return self._map.states_in(self._env.simulation.signal_phases(0))

    def set_state(self, light: int, state: int) -> None:
        """Show a state at a light for its time of that state; OFF or time 0: until another call.

        Raises:
            CallRefused: there is no such state.
            ConfigError: `signals.overrides` is less than the number of links with signals.
        """
        self._check_room()
        if state not in _CODE_OF_STATE:
            raise CallRefused(f"state {state} is not Red, Yellow, Green or Off")
        seconds = float(self.times_s[light, TIMED.index(state)]) if state in TIMED else 0.0
        self._set[light] = _SetState(state, seconds or math.inf)
        self._write()

    def set_time(self, light: int, state: int, seconds: float) -> None:
        """Set the time for which a light has a state, in each cycle of its group.

        The phases of the group in which the light has the state are scaled. For red, the phases
        in which all lights of the group are red are scaled.

        Raises:
            CallRefused: the time is negative or too long.
            ConfigError: see `set_state`.
        """
        self._check_room()
        if not 0.0 <= seconds <= MOST_S:
            raise CallRefused(f"{seconds:g} s: must be from 0 to {MOST_S:g}")
        signal = self._map.approaches[light].signal
        self._seconds.pop((light, state), None)
        self._seconds[light, state] = seconds  # the latest time wins
        group = self._group(signal)
        self._apply_times(signal, group)
        shown = self._set.get(light)
        if shown is not None and shown.state == state:
            shown.left_s = seconds or math.inf
        self._write()

    def freeze(self, is_frozen: bool, light: int | None = None) -> None:
        """Stop the time of a light's group, or of all groups, or let it run again.

        Raises ConfigError: see `set_state`.
        """
        self._check_room()
        signals = self._signals if light is None else [self._map.approaches[light].signal]
        for signal in signals:
            if is_frozen or signal in self._groups:
                self._group(signal).is_frozen = is_frozen
        self._write()

    def reset(self, light: int | None = None) -> None:
        """Begin the cycle of a light's group, or of all groups, with the first phase.

        Lights of these groups no longer show states that clients have set. Times are kept.

        Raises ConfigError: see `set_state`.
        """
        self._check_room()
        signals = self._signals if light is None else [self._map.approaches[light].signal]
        for signal in signals:
            group = self._group(signal)
            group.phase, group.elapsed_s = 0, 0.0
        for number in self._of(signals):
            self._set.pop(number, None)
            self.elapsed_s[number] = 0.0
        self._write()

    def advance(self, step_s: float) -> None:
        """Advance the lights that clients control by a step, before the world's step."""
        is_changed = False
        for group in self._groups.values():
            if not group.is_frozen:
                is_changed |= group.advance(step_s)
        is_frozen = self.is_frozen
        for light, shown in list(self._set.items()):
            if not is_frozen[light]:
                shown.left_s -= step_s
                if shown.left_s < 0.5 * step_s:
                    del self._set[light]
                    is_changed = True
        if is_changed:
            self._write()

    def note(self, step_s: float) -> None:
        """Record how long the lights have had their states, after the world's step."""
        states = self.states()
        self.elapsed_s[~self.is_frozen] += step_s
        self.elapsed_s[states != self._states] = 0.0
        self._states = states

    @property
    def _signals(self) -> list[int]:
        return sorted({one.signal for one in self._map.approaches})

    def _of(self, signals: list[int]) -> list[int]:
        """Return the lights of signals."""
        chosen = set(signals)
        return [k for k, one in enumerate(self._map.approaches) if one.signal in chosen]

    def _check_room(self) -> None:
        room = self._env.config.signals.overrides
        if room < self._num_links:
            raise ConfigError(
                f"signals.overrides = {room}: the signals of this map control {self._num_links} "
                f"links; set it to at least {self._num_links}"
            )

    def _group(self, signal: int) -> _Group:
        """Return the group of a signal; the first call takes it over from its program."""
        if signal in self._groups:
            return self._groups[signal]
        network, simulation = self._network, self._env.simulation
        row = int(simulation.signal_phases(0)[signal])
        programs = network.programs
        ends = programs["first_phase"] + programs["num_phases"]
        is_own = (programs["signal"] == signal) & (programs["first_phase"] <= row) & (row < ends)
        program = programs[is_own][0]
        first, number = int(program["first_phase"]), int(program["num_phases"])
        durations_s = network.phases["duration_s"][first : first + number].copy()
        time_s = float(simulation.ticks()[0]) * self._env.config.clock.sim_dt_s
        if program["controller"] >= 0:
            following = (network.phases["following"][first : first + number] - first).tolist()
            controllers = simulation.shards[0].worlds.controllers[0]
            elapsed_s = time_s - 1e-3 * float(controllers["since_ms"][program["controller"]])
        else:
            following = [*range(1, number), 0]
            in_cycle_s = (time_s - float(program["offset_s"])) % float(program["cycle_s"])
            elapsed_s = in_cycle_s - float(durations_s[: row - first].sum())
        group = _Group(first, following, durations_s, row - first, max(elapsed_s, 0.0))
        self._groups[signal] = group
        return group

    def _apply_times(self, signal: int, group: _Group) -> None:
        """Scale the phases of a group to the times of its lights."""
        rows = slice(group.first, group.first + len(group.following))
        base_s = self._network.phases["duration_s"][rows]
        lights = self._of([signal])
        states = self._map.states[lights, rows]
        group.durations_s = base_s.copy()
        for (light, state), seconds in self._seconds.items():
            if light not in lights:
                continue
            shown = states[lights.index(light)] == state
            if state == RED:
                shown = (states == RED).all(axis=0)
            if shown.any():
                group.durations_s[shown] = base_s[shown] * (seconds / base_s[shown].sum())
        for light, own in zip(lights, states, strict=True):
            for column, state in enumerate(TIMED):
                shown = own == state
                wanted = self._seconds.get((light, state))
                if wanted is not None and (state == RED or not shown.any()):
                    self.times_s[light, column] = wanted
                else:
                    self.times_s[light, column] = group.durations_s[shown].sum()

    def _write(self) -> None:
        """Pass the states that differ from the map's programs to the environment."""
        network = self._network
        links = network.links
        codes = np.full(len(links), SIGNAL_NONE, np.uint8)
        for signal, group in self._groups.items():
            own = np.flatnonzero(links["signal"] == signal)
            first = int(network.phases["first_state"][group.first + group.phase])
            codes[own] = network.phase_states[first + links["signal_index"][own]]
        for light, shown in self._set.items():
            own = self._map.links_of[light]
            codes[own] = _CODE_OF_STATE[shown.state]
            if shown.state == GREEN:
                codes[own[self._yields(light)]] = _GREEN_MINOR
        self._env.signal_overrides.show_links(codes)

    def _yields(self, light: int) -> NDArray[np.bool_]:
        """Return which links of a light have a green that yields, in any phase of the map."""
        network = self._network
        signal = self._map.approaches[light].signal
        found = np.zeros(len(self._map.links_of[light]), np.bool_)
        for program in network.programs[network.programs["signal"] == signal]:
            rows = slice(program["first_phase"], program["first_phase"] + program["num_phases"])
            for first in network.phases["first_state"][rows].tolist():
                letters = first + network.links["signal_index"][self._map.links_of[light]]
                found |= network.phase_states[letters] == _GREEN_MINOR
        return found
