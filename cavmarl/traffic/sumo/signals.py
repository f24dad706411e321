"""`ShownSignals`: what SUMO's signals show, as the phases that ours are in."""

from __future__ import annotations

from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from cavmarl.errors import SumoStateError
from cavmarl.roads.network import SIGNAL_STATES, RoadNetwork

__all__ = ["ShownSignals"]


class ShownSignals:
    """Finds the phase of each signal that shows the same letters.

    Args:
        network: the roads, with all programs that SUMO has.
    """

    def __init__(self, network: RoadNetwork) -> None:
        self._ids = network.signal_ids
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

    def show(self, letters: bytes, phase: NDArray[np.int32]) -> None:
        """Write the PHASE rows of a world's signals.

        Args:
            letters: of all signals, one after the other.
            phase: (num_signals,) is written.

        Raises:
            SumoStateError: a signal shows what no program of the map's has.
        """
        for signal, part in enumerate(self._parts):
            row = self._rows.get((signal, letters[part]))
            if row is None:
                raise SumoStateError(
                    f"signal '{self._ids[signal]}' shows '{letters[part].decode()}', which no "
                    "phase of its programs does: give all of its programs as <tlLogic> in the map "
                    "or in an additional file of the demand"
                )
            phase[signal] = row
