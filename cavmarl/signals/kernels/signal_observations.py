"""Observations and rewards of signals that agents control.

Sources: the defaults of sumo-rl 1.4.5 (Alegre, 2019): observation, and the rewards
    diff-waiting-time, average-speed, queue and pressure.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.signals.kernels.controlled_signals import ControlledSignals, SignalTicks
from cavmarl.signals.kernels.green_choices import GREEN, SINCE
from cavmarl.signals.kernels.lane_counts import (
    LENGTH_MM,
    SPEED_PPM,
    STANDING,
    STOOD_TICKS,
    VEHICLES,
)

MIN_GAP_M = 2.5  # assumed gap between stopped vehicles, for the capacity of a lane
WAIT_SCALE_S = 100.0  # scale of the terms diff_wait and wait


@kernel
def observe_signals(
    controlled: ControlledSignals,
    durations: SignalTicks,
    ticks: NDArray[np.int64],  # (W,)
    chosen: NDArray[np.bool_],  # (W,) worlds in which a decision is due
    held: NDArray[np.int64],  # (W, S, HELD)
    counts: NDArray[np.int64],  # (W, N, COUNTS)
    observations: NDArray[np.float32],  # (W, S, D), overwritten in the chosen worlds
) -> None:
    """Write the observations of the chosen worlds.

    An observation has the current green in one-hot encoding; 1 if the green may end, else 0; the
    density of each incoming lane; and the density of stopped vehicles on each incoming lane. The
    density is the number of vehicles divided by the capacity of the lane, at most 1.
    """
    for w in range(ticks.size):
        if not chosen[w]:
            continue
        for s in range(controlled.row.size):
            out = observations[w, s]
            out[:] = 0.0
            num_greens = controlled.num_greens[s]
            out[held[w, s, GREEN]] = 1.0
            lasted = ticks[w] - held[w, s, SINCE]
            least = durations.yellow + durations.all_red + durations.min_green
            out[num_greens] = 1.0 if lasted >= least else 0.0
            num_lanes = 0
            while (
                num_lanes < controlled.incoming.shape[1] and controlled.incoming[s, num_lanes] >= 0
            ):
                num_lanes += 1
            for k in range(num_lanes):
                lane = controlled.incoming[s, k]
                found = counts[w, lane]
                if found[VEHICLES] == 0:
                    continue
                mean_m = found[LENGTH_MM] * 1e-3 / found[VEHICLES]
                share = (MIN_GAP_M + mean_m) / controlled.length_m[lane]
                out[num_greens + 1 + k] = min(1.0, found[VEHICLES] * share)
                out[num_greens + 1 + num_lanes + k] = min(1.0, found[STANDING] * share)


@kernel
def reward_signals(
    controlled: ControlledSignals,
    dt: float,
    weights: NDArray[np.float64],  # (T,) of SIGNAL_TERMS
    chosen: NDArray[np.bool_],  # (W,) worlds whose rewards are written
    observed: NDArray[np.bool_],  # (W,) worlds in which a decision is due
    ends: bool,  # whether an interval between decisions has ended; else the first interval begins
    counts: NDArray[np.int64],  # (W, N, COUNTS)
    stood: NDArray[np.int64],  # (W, S) STOOD_TICKS of `approach` at the last decision, updated
    terms: NDArray[np.float32],  # (W, S, T) overwritten; 0 where no interval ends
    rewards: NDArray[np.float32],  # (W, S) overwritten; 0 where no interval ends
) -> None:
    """Write the reward terms for the interval since the last decision, and their weighted sum."""
    for w in range(chosen.size):
        if not chosen[w]:
            continue
        for s in range(controlled.row.size):
            terms[w, s] = 0.0
            rewards[w, s] = 0.0
            if not (observed[w] and ends):
                continue
            vehicles, standing, waited, speed, beyond = 0, 0, 0, 0, 0
            for k in range(controlled.approach.shape[1]):
                lane = controlled.approach[s, k]
                if lane >= 0:
                    vehicles += counts[w, lane, VEHICLES]
                    standing += counts[w, lane, STANDING]
                    waited += counts[w, lane, STOOD_TICKS]
                    speed += counts[w, lane, SPEED_PPM]
            for k in range(controlled.outgoing.shape[1]):
                lane = controlled.outgoing[s, k]
                if lane >= 0:
                    beyond += counts[w, lane, VEHICLES]
            values = terms[w, s]
            values[0] = (stood[w, s] - waited) * dt / WAIT_SCALE_S
            values[1] = speed * 1e-6 / vehicles if vehicles > 0 else 1.0
            values[2] = -standing
            values[3] = beyond - vehicles
            values[4] = speed * 1e-6 - vehicles
            values[5] = -waited * dt / WAIT_SCALE_S
            stood[w, s] = waited
            total = 0.0
            for t in range(weights.size):
                if weights[t] != 0.0:
                    total += weights[t] * np.float64(values[t])
            rewards[w, s] = total
