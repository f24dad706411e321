"""The state of signals for a stack: given by the world, or received from roadside units."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import SIGNAL_NONE, SIGNAL_RED
from cavmarl.cosim.stack.hd_map import HdMap
from cavmarl.cosim.stack.stack_types import Readings

SPAT = "v2x.spat"  # key in a vehicle's readings: (n, 3) SIGNAL row, PHASE row, age in ticks


class ToldSignals:
    """Signals as given by the world, which is ground truth."""

    def read(self, readings: Readings, told: NDArray[np.uint8] | None) -> NDArray[np.uint8] | None:
        return told


class SpatSignals:
    """Signals from SPAT messages (SAE J2735) that the vehicle has received.

    The letters of a phase come from the map. A signal without a message counts as red: the vehicle
    stops at its line.
    """

    def __init__(self, hd_map: HdMap) -> None:
        network = hd_map.network
        self._network = network
        self._has_one = network.links["signal"] >= 0

    def read(self, readings: Readings, told: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
        """Return (num_links,) SIGNAL_* codes."""
        network = self._network
        shown = np.full(len(network.links), SIGNAL_NONE, dtype=np.uint8)
        shown[self._has_one] = SIGNAL_RED
        messages = readings.get(SPAT)
        if messages is None or not len(messages.values):
            return shown
        for signal, phase, _ in messages.values[-1].tolist():
            links = np.flatnonzero(network.links["signal"] == signal)
            letters = network.phases["first_state"][phase] + network.links["signal_index"][links]
            shown[links] = network.phase_states[letters]
        return shown
