"""Greens that agents choose: the allowed choices, and the phases between two greens.

The phase is a function of the tick and the last change, so repeated calls in a tick change nothing.
W is the number of worlds, S of signals, and G the largest number of greens of a signal.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.signals.kernels.controlled_signals import ControlledSignals, SignalTicks

# Columns of the state (W, S, HELD) of the signals that agents control.
PREVIOUS = 0  # the green before the last change
GREEN = 1  # the current green, or the next green during yellow and all-red
SINCE = 2  # tick of the last change
REFUSED = 3  # number of choices in the episode that were not allowed
HELD = 4

KEEP = -1  # a choice: no change

NEVER_MS = 1 << 60  # time of the next check of a program that only its agent changes


@kernel
def choose_greens(
    controlled: ControlledSignals,
    durations: SignalTicks,
    cyclic: bool,  # whether choices are 0 (keep) and 1 (next green), else indices of greens
    choices: NDArray[np.int64],  # (W, S) KEEP, or a choice
    ticks: NDArray[np.int64],  # (W,)
    held: NDArray[np.int64],  # (W, S, HELD) updated
) -> None:
    """Change the greens as agents have chosen, in worlds in which a decision is due.

    A choice that is not allowed counts as refused; the green stays, or ends if it has reached its
    maximum.
    """
    for w in range(ticks.size):
        if ticks[w] % durations.decide != 0:
            continue
        for s in range(controlled.row.size):
            state = held[w, s]
            green, num_greens = state[GREEN], controlled.num_greens[s]
            wanted = choices[w, s]
            if wanted == KEEP:
                wanted = green
            elif cyclic:
                wanted = (green + wanted) % num_greens
            must = _must_change(durations, ticks[w], state)
            if wanted == green:
                if must:
                    state[REFUSED] += choices[w, s] != KEEP
                    _change(state, (green + 1) % num_greens, ticks[w])
            elif _may_change(durations, ticks[w], state):
                _change(state, wanted, ticks[w])
            else:
                state[REFUSED] += 1


@kernel
def show_greens(
    controlled: ControlledSignals,
    durations: SignalTicks,
    dt: float,
    ticks: NDArray[np.int64],  # (W,)
    held: NDArray[np.int64],  # (W, S, HELD)
    controllers: NDArray[np.void],  # CONTROLLER (W, num_controllers), updated
    signal_phase: NDArray[np.int32],  # (W, num_signals), updated
) -> None:
    """Set the phases of the signals at the worlds' current ticks."""
    for w in range(ticks.size):
        for s in range(controlled.row.size):
            state = held[w, s]
            before, green, since = state[PREVIOUS], state[GREEN], state[SINCE]
            num_greens = controlled.num_greens[s]
            phase, begin = green, since
            if before != green:
                pair = before * (num_greens - 1) + (green if green < before else green - 1)
                first = num_greens
                if ticks[w] - since < durations.yellow:
                    phase = first + pair
                elif ticks[w] - since < durations.yellow + durations.all_red:
                    if durations.yellow > 0:
                        first += num_greens * (num_greens - 1)
                    phase, begin = first + pair, since + durations.yellow
                else:
                    begin = since + durations.yellow + durations.all_red
            record = controllers[w, controlled.controller[s]]
            record["phase"] = controlled.first_phase[s] + phase
            record["since_ms"] = math.floor(begin * dt * 1e3 + 0.5)
            record["next_ms"] = NEVER_MS
            signal_phase[w, controlled.row[s]] = record["phase"]


@kernel
def mask_choices(
    controlled: ControlledSignals,
    durations: SignalTicks,
    cyclic: bool,  # see `choose_greens`
    ticks: NDArray[np.int64],  # (W,)
    held: NDArray[np.int64],  # (W, S, HELD)
    decides: NDArray[np.bool_],  # (W,) output: whether the next choices count
    masks: NDArray[np.bool_],  # (W, S, G) output: choices that are allowed
) -> None:
    """Write the choices that are allowed in the next step."""
    for w in range(ticks.size):
        decides[w] = ticks[w] % durations.decide == 0
        for s in range(controlled.row.size):
            state = held[w, s]
            must = decides[w] and _must_change(durations, ticks[w], state)
            may = decides[w] and _may_change(durations, ticks[w], state)
            num_greens = controlled.num_greens[s]
            for choice in range(masks.shape[2]):
                if cyclic:
                    keeps, exists = choice == 0, choice < 2
                else:
                    keeps, exists = choice == state[GREEN], choice < num_greens
                masks[w, s, choice] = exists and (not must if keeps else may)


@kernel
def _may_change(durations: SignalTicks, tick: int, state: NDArray[np.int64]) -> bool:
    """Return whether the green has lasted for its minimum.

    As in sumo-rl, an episode begins as if the first green had just been chosen.
    """
    lasted = tick - state[SINCE] - durations.yellow - durations.all_red
    return bool(lasted >= durations.min_green)


@kernel
def _must_change(durations: SignalTicks, tick: int, state: NDArray[np.int64]) -> bool:
    """Return whether the green has lasted for its maximum."""
    lasted = tick - state[SINCE] - durations.yellow - durations.all_red
    return bool(durations.max_green > 0 and lasted >= durations.max_green)


@kernel
def _change(state: NDArray[np.int64], green: int, tick: int) -> None:
    state[PREVIOUS] = state[GREEN]
    state[GREEN] = green
    state[SINCE] = tick
