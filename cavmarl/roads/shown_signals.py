"""The states that the signals of a world show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import SIGNAL_NONE
from cavmarl.roads.network import RoadNetwork


def signal_codes(network: RoadNetwork, signal_phases: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Return the code at each link (num_links,): an index in SIGNAL_STATES, or SIGNAL_NONE.

    `signal_phases`: present phases of a world, see `Worlds.signal_phase`.
    """
    codes = np.full(len(network.links), SIGNAL_NONE, dtype=np.uint8)
    signalled = np.flatnonzero(network.links["signal"] >= 0)
    links = network.links[signalled]
    first = network.phases["first_state"][signal_phases[links["signal"]]]
    codes[signalled] = network.phase_states[first + links["signal_index"]]
    overridden = signal_phases[len(network.signals) :]
    shown = np.flatnonzero(overridden)
    codes[shown] = overridden[shown] - 1
    return codes
