"""Time to the next change of a signal, as roadside units broadcast it (SPaT, SAE J2735)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import RoadArrays
from cavmarl.roads.kernels.signal_overrides import NOT_OVERRIDDEN, overridden_state
from cavmarl.roads.kernels.signal_phases import program_at


@kernel
def time_to_change(
    roads: RoadArrays,
    # CONTROLLER (num_controllers,), the state of the actuated programs
    controllers: NDArray[np.void],
    link: int,  # LINK row that has a signal
    phase: NDArray[np.int32],  # (num_signals + …,) see `Worlds.signal_phase`
    time: float,  # s since the world's reset
    dt: float,  # length of a tick, s
) -> float:
    """Return the time in s until the signal of a link changes its state.

    If the state never changes, the result is the length of the cycle. For an actuated program it is
    the earliest possible time: each phase counts with its minimum duration. A state that the caller
    shows can change at any time.
    """
    if overridden_state(roads, link, phase) != NOT_OVERRIDDEN:
        return 0.0
    index = roads.links[link]["signal_index"]
    signal = roads.links[link]["signal"]
    program = roads.programs[program_at(roads, signal, time, dt)]
    actuated = program["controller"] >= 0
    row = phase[signal]
    letter = roads.phase_states[roads.phases[row]["first_state"] + index]
    if actuated:
        left = 1e-3 * controllers[program["controller"]]["since_ms"] - time
    else:
        left = -((time - program["offset_s"]) % program["cycle_s"])
        for earlier in range(program["first_phase"], row):
            left += roads.phases[earlier]["duration_s"]
    # Add the phases from the start of the active phase to the first phase with another state.
    for _ in range(program["num_phases"]):
        if roads.phase_states[roads.phases[row]["first_state"] + index] != letter:
            return float(max(left, 0.0))
        if actuated:
            left += 1e-3 * roads.phases[row]["min_ms"]
            row = roads.phases[row]["following"]
        else:
            left += roads.phases[row]["duration_s"]
            row += 1
            if row == program["first_phase"] + program["num_phases"]:
                row = program["first_phase"]
    return float(program["cycle_s"])
