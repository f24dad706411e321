"""Time to the next change of a signal, as roadside units broadcast it (SPaT, SAE J2735)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import RoadArrays
from cavmarl.core.records.codes import CHOSEN_BY_AGENT, SIGNAL_GREEN_MAJOR, SIGNAL_GREEN_MINOR
from cavmarl.roads.kernels.signal_overrides import NOT_OVERRIDDEN, overridden_state
from cavmarl.roads.kernels.signal_phases import program_at


@kernel
def time_to_change(
    roads: RoadArrays,
    # CONTROLLER (num_controllers,), the state of the actuated programs
    controllers: NDArray[np.void],
    link: int,  # LINK row with a signal
    phase: NDArray[np.int32],  # (num_signals + …,) see `Worlds.signal_phase`
    time: float,  # s since the world's reset
    dt: float,  # length of a tick, s
) -> float:
    """Return the time in s until the signal of a link changes its state.

    If the state never changes, the result is the length of the cycle. For an actuated program, and
    for a program whose greens are chosen, it is the earliest possible time: each phase counts with
    its minimum duration, and any green may be chosen next. If the caller of the environment
    overrides the state, it can change at any time, so the result is 0.
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
    if program["detector_gap_s"] == CHOSEN_BY_AGENT:
        ends = left + 1e-3 * roads.phases[row]["min_ms"]
        soonest = soonest_choice(roads, program, row, index, ends, False)
        return float(max(soonest, 0.0)) if soonest < math.inf else float(program["cycle_s"])
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


@kernel
def soonest_choice(
    roads: RoadArrays, program: np.void, row: int, index: int, end_s: float, by_green: bool
) -> float:
    """Return the earliest time in s at which a link's state changes, if greens are chosen.

    The result is inf if the state never changes. `program`: has its greens and, for each pair of
    greens, the phases between them; see `signals.agent_programs`. `row`: active PHASE row, which
    ends in `end_s` s, or can end then if it is a green. `index`: of the link's letter. `by_green`:
    whether only changes between green letters and all others count.
    """
    now = _shown(roads, row, index, by_green)
    left = end_s
    while not roads.phases[row]["green"]:
        row = roads.phases[row]["following"]
        if _shown(roads, row, index, by_green) != now:
            return float(left)
        left += 1e-3 * roads.phases[row]["min_ms"]
    # The green may end after its minimum, and any other green may follow.
    first = program["first_phase"]
    num_greens = 0
    while num_greens < program["num_phases"] and roads.phases[first + num_greens]["green"]:
        num_greens += 1
    soonest = math.inf
    for other in range(num_greens):
        if first + other == row:
            continue
        after, next_row = left, first + other
        if program["num_phases"] > num_greens:
            green = row - first
            pair = green * (num_greens - 1) + (other if other < green else other - 1)
            next_row = first + num_greens + pair
        for _ in range(3):  # yellow, red for all, green
            if _shown(roads, next_row, index, by_green) != now:
                soonest = min(soonest, after)
                break
            if roads.phases[next_row]["green"]:
                break
            after += 1e-3 * roads.phases[next_row]["min_ms"]
            next_row = roads.phases[next_row]["following"]
    return soonest


@kernel
def _shown(roads: RoadArrays, row: int, index: int, by_green: bool) -> int:
    """Return the letter of a link in a PHASE row or, if `by_green`, 1 for green and 0 otherwise."""
    letter = roads.phase_states[roads.phases[row]["first_state"] + index]
    if by_green:
        return int(letter == SIGNAL_GREEN_MAJOR or letter == SIGNAL_GREEN_MINOR)
    return int(letter)
