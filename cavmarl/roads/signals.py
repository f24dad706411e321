"""Signal programs as SIGNAL and PHASE rows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.errors import MapError
from cavmarl.roads.network import PHASE, SIGNAL, SIGNAL_STATES

__all__ = ["SignalRows", "read_signals"]

# Trains switch these; no train runs here, so their links are read as links without a signal.
RAIL_KINDS = ("rail_signal", "rail_crossing")


class SignalRows:
    """The signals of a map: rows, letters, and the row of every id."""

    def __init__(self) -> None:
        self.ids: list[str] = []
        self.signals: list[tuple[int, int, int, float, float]] = []
        self.phases: list[tuple[float, int]] = []
        self.letters: list[int] = []
        self.row: dict[str, int] = {}

    def add(self, signal_id: str, program: Any) -> None:
        """Append a signal with its program.

        Raises:
            MapError: no phases, phases of different lengths, an unknown letter, a cycle of no time.
        """
        phases = program.getPhases()
        num_links = len(phases[0].state) if phases else 0
        cycle = float(sum(phase.duration for phase in phases))
        if not num_links or cycle <= 0.0:
            raise _error(signal_id, "has a program without phases or without duration")
        first_phase = len(self.phases)
        for phase in phases:
            if len(phase.state) != num_links:
                raise _error(signal_id, "has phases for different numbers of links")
            if phase.duration < 0:
                raise _error(signal_id, "has a phase of negative duration")
            unknown = set(phase.state) - set(SIGNAL_STATES)
            if unknown:
                raise _error(signal_id, f"has the unknown states {sorted(unknown)}")
            self.phases.append((phase.duration, len(self.letters)))
            self.letters.extend(map(SIGNAL_STATES.index, phase.state))
        self.row[signal_id] = len(self.ids)
        self.ids.append(signal_id)
        self.signals.append((first_phase, len(phases), num_links, program.getOffset(), cycle))

    def find(self, connection: Any, junction_kind: str) -> tuple[int, int]:
        """The SIGNAL row and state letter of a connection, (-1, -1) without a signal.

        Raises:
            MapError: the connection's signal has no program or no letter for it.
        """
        signal_id = connection.getTLSID()
        if not signal_id or (signal_id not in self.row and junction_kind in RAIL_KINDS):
            return -1, -1
        if signal_id not in self.row:
            raise _error(signal_id, "controls connections but has no program")
        row = self.row[signal_id]
        index = int(connection.getTLLinkIndex())
        if not 0 <= index < self.signals[row][2]:
            raise _error(signal_id, f"has no state for link {index}")
        return row, index

    def arrays(self) -> tuple[NDArray[np.void], NDArray[np.void], NDArray[np.uint8]]:
        """SIGNAL rows, PHASE rows and phase_states."""
        signals = np.zeros(len(self.signals), SIGNAL)
        signals[:] = self.signals
        phases = np.zeros(len(self.phases), PHASE)
        phases[:] = self.phases
        return signals, phases, np.array(self.letters, dtype=np.uint8)


def read_signals(net: Any) -> SignalRows:
    """The first program of every traffic light of a sumolib network.

    Raises:
        MapError: see `SignalRows.add`.
    """
    rows = SignalRows()
    for light in net.getTrafficLights():
        programs = list(light.getPrograms().values())
        if programs:
            rows.add(light.getID(), programs[0])
    return rows


def _error(signal_id: str, problem: str) -> MapError:
    return MapError(
        f"signal '{signal_id}' {problem}: mend its <tlLogic> or build it again "
        "(netconvert --tls.rebuild)"
    )
