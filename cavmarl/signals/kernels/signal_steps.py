"""The part of a tick that concerns signals whose greens are chosen, as three calls."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.signals.kernels.controlled_signals import (
    ControlledSignals,
    LaneWeights,
    SignalTicks,
)
from cavmarl.signals.kernels.green_choices import choose_greens, mask_choices, show_greens
from cavmarl.signals.kernels.lane_counts import count_lanes, count_standing
from cavmarl.signals.kernels.lane_history import follow_detectors, follow_lanes
from cavmarl.signals.kernels.signal_observations import observe_signals, reward_signals


class SignalRules(NamedTuple):
    """The signals whose greens are chosen, and the rules for choices, for kernels."""

    controlled: ControlledSignals
    served: LaneWeights  # see `SignalTable`
    durations: SignalTicks
    cyclic: bool  # whether choices are 0 (keep) and 1 (next green), else they are indices of greens
    dt: float
    near_m: float  # see `count_lanes`
    weights: NDArray[np.float64]  # (T,) of SIGNAL_TERMS


class SignalWorlds(NamedTuple):
    """The state of W worlds that these signals read and write."""

    ticks: NDArray[np.int64]  # (W,)
    controllers: NDArray[np.void]  # CONTROLLER (W, num_controllers)
    keys: NDArray[np.uint64]  # (W,)
    signal_phase: NDArray[np.int32]  # (W, num_signals)
    detected_s: NDArray[np.float64]  # (W, D)
    lanes: NDArray[np.void]  # LANE (V, L), see `Worlds`
    rows: NDArray[np.void]  # VEHICLE (2, k, W, C), see `ZoneState`
    sides: NDArray[np.int64]  # (2,) index of the committed half of `rows`; second number unused
    num_owned: NDArray[np.int64]  # (k, W)


class SignalOutputs(NamedTuple):
    """State and outputs of S signals.

    Observations and counts are from the last decision and the sensors of `signals.sensing`. G is
    the largest number of greens of a signal, N the number of watched lanes, T the number of terms.
    """

    observations: NDArray[np.float32]  # (W, S, D)
    rewards: NDArray[np.float32]  # (W, S) 0 in steps that do not end an interval between decisions
    terms: NDArray[np.float32]  # (W, S, T)
    masks: NDArray[np.bool_]  # (W, S, G) choices that are allowed in the next step
    decides: NDArray[np.bool_]  # (W,) whether choices count in the next step
    counts: NDArray[np.int64]  # (W, N, COUNTS) see `signals.kernels.lane_counts`
    states: NDArray[np.int64]  # (W, S, HELD) see `signals.kernels.green_choices`
    history: NDArray[np.int64]  # (W, N, HISTORY) see `signals.kernels.lane_history`
    # (W, N, 2, READINGS) of induction loops, see `signals.kernels.loop_counts`; (W, 0, …) without
    loops: NDArray[np.int64]


@kernel
def begin_signal_step(
    rules: SignalRules,
    worlds: SignalWorlds,
    outputs: SignalOutputs,
    choices: NDArray[np.int64],  # (W, S), see `choose_greens`
) -> None:
    """Change the greens as chosen, and set the phases of the current tick."""
    choose_greens(
        rules.controlled, rules.durations, rules.cyclic, choices, worlds.ticks, outputs.states
    )
    _show(rules, worlds, outputs)


@kernel
def end_signal_tick(
    rules: SignalRules,
    worlds: SignalWorlds,
    outputs: SignalOutputs,
    chosen: NDArray[np.bool_],  # (W,) worlds in which a tick has ended
) -> None:
    """Set the phases of the current tick, and count stopped and detected vehicles."""
    _show(rules, worlds, outputs)
    rows = worlds.rows[worlds.sides[0]]
    count_standing(rows, worlds.num_owned, rules.controlled.lane_index, chosen)
    follow_detectors(
        rules.controlled,
        rules.durations.flow_interval,
        rules.dt,
        chosen,
        worlds.ticks,
        worlds.detected_s,
        outputs.history,
    )


@kernel
def count_truth(
    rules: SignalRules,
    worlds: SignalWorlds,
    outputs: SignalOutputs,
    chosen: NDArray[np.bool_],  # (W,) worlds to observe, if a decision is due
    observed: NDArray[np.bool_],  # (W,) output
    truth: NDArray[np.int64],  # (W, N, COUNTS), overwritten in the observed worlds
) -> None:
    """Write the choices allowed in the next step, and count all vehicles on the watched lanes."""
    mask_choices(
        rules.controlled,
        rules.durations,
        rules.cyclic,
        worlds.ticks,
        outputs.states,
        outputs.decides,
        outputs.masks,
    )
    for w in range(chosen.size):
        observed[w] = chosen[w] and outputs.decides[w]
    rows = worlds.rows[worlds.sides[0]]
    count_lanes(
        rules.controlled, worlds.lanes, rules.near_m, rows, worlds.num_owned, observed, truth
    )


@kernel
def observe_and_reward(
    rules: SignalRules,
    worlds: SignalWorlds,
    outputs: SignalOutputs,
    chosen: NDArray[np.bool_],  # (W,) as in `count_truth`, like the next two arguments
    observed: NDArray[np.bool_],  # (W,)
    truth: NDArray[np.int64],  # (W, N, COUNTS)
    stood: NDArray[np.int64],  # (W, S) see `reward_signals`
    rewarded: NDArray[np.bool_],  # (1,) whether an interval between decisions has ended
) -> None:
    """Write the observations from sensed counts of lanes, and the rewards from true counts."""
    follow_lanes(
        rules.controlled,
        rules.served,
        rules.durations,
        observed,
        worlds.ticks,
        outputs.states,
        outputs.counts,
        outputs.history,
    )
    observe_signals(
        rules.controlled,
        rules.durations,
        worlds.ticks,
        observed,
        outputs.states,
        outputs.counts,
        outputs.observations,
    )
    reward_signals(
        rules.controlled,
        rules.dt,
        rules.weights,
        chosen,
        observed,
        rewarded[0],
        truth,
        stood,
        outputs.terms,
        outputs.rewards,
    )


@kernel
def _show(rules: SignalRules, worlds: SignalWorlds, outputs: SignalOutputs) -> None:
    show_greens(
        rules.controlled,
        rules.durations,
        rules.dt,
        worlds.ticks,
        outputs.states,
        worlds.controllers,
        worlds.signal_phase,
    )
