"""`ShownSignals`: what SUMO's signals show, as the phases that ours are in."""

from __future__ import annotations

from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import SumoError
from cavmarl.roads.network import SIGNAL_STATES, RoadNetwork


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

        Raises:
            SumoError: a signal shows what no program of the map's has.
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
