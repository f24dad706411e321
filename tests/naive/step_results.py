"""The results of a step, computed array by array."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import DepartureQueue, Outputs
from cavmarl.core.records.codes import COUNT_ARRIVED, EVENTS_OF_FATE, EVENTS_THAT_END
from cavmarl.engine.kernels.step_results import Results


def report(outputs: Outputs, steps: NDArray[np.int64], horizon: int, results: Results) -> bool:
    steps += 1
    at_horizon = (steps >= horizon)[:, None]
    for name in ("rewards", "terms", "acted", "vehicle_ids"):
        getattr(results, name)[:] = getattr(outputs, name)
    results.terminations[:] = outputs.terminated
    cut = np.where(outputs.terminated, outputs.events & EVENTS_OF_FATE == 0, at_horizon)
    results.truncations[:] = outputs.acted & cut
    results.vehicle_done[:] = outputs.events & EVENTS_THAT_END != 0
    return bool(outputs.terminated.any())


def report_continuation(
    outputs: Outputs,
    departures: DepartureQueue,
    steps: NDArray[np.int64],
    horizon: int,
    has_signals: bool,
    results: Results,
) -> bool:
    results.arrivals[:] = departures.counts[:, COUNT_ARRIVED]
    results.mask[:] = outputs.present & ~outputs.terminated
    for w, waiting in enumerate(departures.num_queue):
        waits = any(departures.queue["agent"][w, :waiting] >= 0)
        results.episode_over[w] = steps[w] >= horizon or not (
            results.mask[w].any() or waits or has_signals
        )
    return bool(results.episode_over.any())


def keep_last(
    results: Results,
    observations: NDArray[np.float32],
    final_observations: NDArray[np.float32],
    in_next_step: bool,
) -> None:
    ended = results.episode_over | results.terminations.any(axis=1)
    final_observations[ended] = observations[ended]
    if not in_next_step:
        observations[results.terminations] = 0.0
