"""Signals and their programs as SIGNAL, PROGRAM, PHASE and SWITCH rows.

Rows are only appended, so programs of additional files can be added to the programs of a map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.core.records.codes import CHOSEN_BY_AGENT
from cavmarl.roads.network import PHASE, PROGRAM, SIGNAL, SIGNAL_STATES, SWITCH, RoadNetwork
from cavmarl.roads.sumo_net.programs import ProgramPhase, SignalProgram

# Trains switch these signals. There are no trains, so the links count as links without a signal.
RAIL_KINDS = ("rail_signal", "rail_crossing")

MAX_MS = 10**12  # SUMO's largest time: 30 years

# SUMO's default distance from detector to stop line, in seconds at the speed limit.
DETECTOR_GAP_S = 2.0

# Parameters of actuated programs that are not implemented; `map check` lists such programs.
_UNMODELLED = ("linkMaxDur:", "linkMinDur:", "jam-threshold", "vTypes", "coordinated", "file-")


class SignalArrays(NamedTuple):
    """The arrays of a `RoadNetwork` for signals, without detectors."""

    signals: NDArray[np.void]  # SIGNAL (num_signals,)
    programs: NDArray[np.void]  # PROGRAM (num_programs,)
    phases: NDArray[np.void]  # PHASE (num_phases,)
    phase_states: NDArray[np.uint8]  # (num_letters,)
    switches: NDArray[np.void]  # SWITCH (num_switches,)
    program_ids: tuple[str, ...]


class ControlledPhase(NamedTuple):
    """A phase that an agent chooses, or a phase between two such phases."""

    letters: str
    duration_s: float  # duration in the map's program
    min_ms: int
    max_ms: int
    following: int  # number of the next phase in the program
    green: bool


class SignalRows:
    """The signals of a map: rows, states, and the row of every id."""

    def __init__(self) -> None:
        self.ids: list[str] = []
        self.signals: list[list[int]] = []  # program, num_links
        self.programs: list[tuple[Any, ...]] = []
        self.program_ids: list[str] = []
        self.phases: list[tuple[Any, ...]] = []
        self.letters: list[int] = []
        self.switches: list[tuple[int, float, int]] = []
        self.row: dict[str, int] = {}
        self.program_row: dict[tuple[str, str], int] = {}
        self.used_links: dict[int, int] = {}  # by row: number of links that exist
        self.num_controllers = 0
        self.phase_detectors: list[int] = []
        self.specs: dict[int, SignalProgram] = {}  # by row: actuated programs that need detectors

    @classmethod
    def of(cls, network: RoadNetwork) -> SignalRows:
        """Return the rows of a network, so that further rows can be appended."""
        rows = cls()
        rows.ids = list(network.signal_ids)
        rows.row = {name: row for row, name in enumerate(rows.ids)}
        rows.signals = [[int(s["program"]), int(s["num_links"])] for s in network.signals]
        rows.programs = network.programs.tolist()
        for link in network.links[network.links["signal"] >= 0]:
            signal, index = int(link["signal"]), int(link["signal_index"])
            rows.used_links[signal] = max(rows.used_links.get(signal, 0), index + 1)
        rows.program_ids = list(network.program_ids)
        rows.program_row = {
            (rows.ids[program["signal"]], name): row
            for row, (program, name) in enumerate(
                zip(network.programs, network.program_ids, strict=True)
            )
        }
        rows.phases = network.phases.tolist()
        rows.letters = network.phase_states.tolist()
        rows.switches = network.switches.tolist()
        rows.num_controllers = network.num_controllers
        rows.phase_detectors = network.phase_detectors.tolist()
        return rows

    def add(self, program: SignalProgram) -> None:
        """Append a program; the last program of a signal runs, as in SUMO.

        A program without phases changes the offset of the known program with the same name.

        Raises MapError: the program has no type, states of different lengths, an unknown letter, a
        cycle of zero length, or the name of another program.
        """
        signal_id = program.signal_id
        known = self.program_row.get((signal_id, program.program_id))
        if known is not None and not program.phases:
            fields = self.programs[known]
            self.programs[known] = (*fields[:3], program.offset_s, *fields[4:])
            return
        cycle = sum(phase.duration_s for phase in program.phases)
        if not program.phases or not program.phases[0].state or cycle <= 0.0:
            raise _error(signal_id, "has a program without phases or without duration")
        if not program.kind:
            raise _error(signal_id, f"has a program '{program.program_id}' without type")
        if known is not None:
            raise _error(signal_id, f"has two programs '{program.program_id}'")
        if signal_id not in self.row:
            self.row[signal_id] = len(self.ids)
            self.ids.append(signal_id)
            self.signals.append([-1, len(program.phases[0].state)])
        signal = self.row[signal_id]
        row = len(self.programs)
        first = len(self.phases)
        for number, phase in enumerate(program.phases):
            self._add_phase(program, phase, number, first, signal)
        actuated = program.kind == "actuated"
        if actuated:
            self.specs[row] = program
        self.programs.append(
            (
                signal,
                first,
                len(program.phases),
                program.offset_s,
                cycle,
                self._next_controller() if actuated else -1,
                parameter(program, "detector-gap", DETECTOR_GAP_S) if actuated else 0.0,
                _simplified(program),
            )
        )
        self.program_ids.append(program.program_id)
        self.program_row[signal_id, program.program_id] = row
        self.signals[signal][0] = row

    def add_controlled(
        self,
        signal_id: str,
        program_id: str,
        phases: Sequence[ControlledPhase],
        cycle_s: float,
    ) -> None:
        """Append a program whose phases an agent chooses, and select it.

        The signal's lanes get detectors as for an actuated program. `cycle_s`: duration of a cycle,
        for estimates of travel times.
        """
        signal, first = self.row[signal_id], len(self.phases)
        num_links = self.signals[signal][1]
        for letters, duration_s, min_ms, max_ms, following, green in phases:
            state = len(self.letters)
            self.phases.append((duration_s, min_ms, max_ms, first + following, green, state, 0, 0))
            self.letters.extend(map(SIGNAL_STATES.index, letters[:num_links]))
        row = len(self.programs)
        spec = [
            ProgramPhase(
                phase.duration_s,
                1e-3 * phase.min_ms,
                math.inf if phase.green else 1e-3 * phase.min_ms,
                phase.letters,
            )
            for phase in phases
        ]
        self.specs[row] = SignalProgram(signal_id, program_id, "actuated", 0.0, "", spec)
        controller = self._next_controller()
        self.programs.append(
            (signal, first, len(phases), 0.0, cycle_s, controller, CHOSEN_BY_AGENT, False)
        )
        self.program_ids.append(program_id)
        self.program_row[signal_id, program_id] = row
        self.signals[signal][0] = row
        self.switches = [switch for switch in self.switches if switch[0] != signal]

    def _next_controller(self) -> int:
        self.num_controllers += 1
        return self.num_controllers - 1

    def _add_phase(
        self, program: SignalProgram, phase: ProgramPhase, number: int, first: int, signal: int
    ) -> None:
        signal_id, num_links = program.signal_id, self.signals[signal][1]
        if len(phase.state) != len(program.phases[0].state):
            raise _error(signal_id, "has phases for different numbers of links")
        if len(phase.state) < self.used_links.get(signal, num_links):
            raise _error(
                signal_id,
                f"has a program '{program.program_id}' with {len(phase.state)} states for "
                f"{self.used_links.get(signal, num_links)} links",
            )
        if phase.duration_s < 0 or phase.min_s < 0 or phase.max_s < 0:
            raise _error(signal_id, "has a phase of negative duration")
        if unknown := set(phase.state) - set(SIGNAL_STATES):
            raise _error(signal_id, f"has the unknown states {sorted(unknown)}")
        following = phase.following[0] if phase.following else (number + 1) % len(program.phases)
        if not 0 <= following < len(program.phases):
            raise _error(signal_id, f"has a phase that leads to the missing phase {following}")
        green = bool(set(phase.state) & set("gG")) and not set(phase.state) & set("yY")
        self.phases.append(
            (
                phase.duration_s,
                _milliseconds(phase.min_s),
                _milliseconds(phase.max_s),
                first + following,
                green,
                len(self.letters),
                0,
                0,
            )
        )
        # As in SUMO, states beyond the signal's links have no effect.
        state = phase.state[:num_links].ljust(num_links, "r")
        self.letters.extend(map(SIGNAL_STATES.index, state))

    def set_detectors(self, program: int, phase: int, detectors: list[int]) -> None:
        """Set the DETECTOR rows that prolong a phase of a program; the phase is given by number."""
        row = int(self.programs[program][1]) + phase
        self.phases[row] = (*self.phases[row][:-2], len(self.phase_detectors), len(detectors))
        self.phase_detectors += detectors

    def find(self, connection: Any, junction_kind: str) -> tuple[int, int]:
        """Return a connection's SIGNAL row and index of its letter; (-1, -1) without a signal.

        Raises MapError: the connection's signal has no program, or no letter for it.
        """
        signal_id = connection.getTLSID()
        if not signal_id or (signal_id not in self.row and junction_kind in RAIL_KINDS):
            return -1, -1
        if signal_id not in self.row:
            raise _error(signal_id, "controls connections but has no program")
        row = self.row[signal_id]
        index = int(connection.getTLLinkIndex())
        if not 0 <= index < self.signals[row][1]:
            raise _error(signal_id, f"has no state for link {index}")
        return row, index

    def arrays(self) -> SignalArrays:
        signals = np.zeros(len(self.signals), SIGNAL)
        switches = np.zeros(len(self.switches), SWITCH)
        switches[:] = sorted(self.switches)
        for row, (program, num_links) in enumerate(self.signals):
            first, end = np.searchsorted(switches["signal"], [row, row + 1])
            signals[row] = (program, num_links, first, end - first)
        programs = np.zeros(len(self.programs), PROGRAM)
        programs[:] = self.programs
        phases = np.zeros(len(self.phases), PHASE)
        phases[:] = self.phases
        letters = np.array(self.letters, dtype=np.uint8)
        return SignalArrays(signals, programs, phases, letters, switches, tuple(self.program_ids))


def read_signals(programs: list[SignalProgram]) -> SignalRows:
    """Return the programs of a network's traffic lights.

    Raises MapError: see `SignalRows.add`.
    """
    rows = SignalRows()
    for program in programs:
        rows.add(program)
    return rows


def _simplified(program: SignalProgram) -> bool:
    """Return whether SUMO would run the program differently."""
    chooses = any(len(phase.following) > 1 for phase in program.phases)
    if program.kind != "actuated":
        jumps = any(
            phase.following not in ((), ((number + 1) % len(program.phases),))
            for number, phase in enumerate(program.phases)
        )
        return program.kind != "static" or jumps
    return chooses or any(
        key.startswith(_UNMODELLED) and value not in ("", "-1")
        for key, value in program.params.items()
    )


def parameter(program: SignalProgram, key: str, default: float) -> float:
    """Return a parameter of a program in seconds.

    Raises MapError: the parameter is not a number of at least 0.
    """
    text = program.params.get(key)
    if text is None:
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0.0):
        raise MapError(f"{program.place} has {key}='{text}': write a number of seconds, at least 0")
    return value


def _milliseconds(seconds: float) -> int:
    return MAX_MS if seconds * 1e3 >= MAX_MS else round(seconds * 1e3)


def _error(signal_id: str, problem: str) -> MapError:
    return MapError(
        f"signal '{signal_id}' {problem}: repair its <tlLogic> or build it again "
        "(netconvert --tls.rebuild)"
    )
