"""The results of a step, except observations, in one pass over the agents.

A step writes about ten small arrays. With NumPy this takes about thirty calls. Each call waits for
memory, because the kernels before it have filled the caches with vehicles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import DepartureQueue, Outputs
from cavmarl.core.records.codes import COUNT_ARRIVED, EVENTS_OF_FATE, EVENTS_THAT_END


class Results(NamedTuple):
    """Some of the arrays of `step_arrays.StepArrays`, which describes them."""

    rewards: NDArray[np.float32]  # (W, A)
    terms: NDArray[np.float32]  # (W, A, T)
    terminations: NDArray[np.bool_]  # (W, A)
    truncations: NDArray[np.bool_]  # (W, A)
    acted: NDArray[np.bool_]  # (W, A)
    vehicle_done: NDArray[np.bool_]  # (W, A)
    vehicle_ids: NDArray[np.int64]  # (W, A)
    mask: NDArray[np.bool_]  # (W, A)
    arrivals: NDArray[np.int64]  # (W,)
    episode_over: NDArray[np.bool_]  # (W,)


@kernel
def report(
    outputs: Outputs,  # of the step
    steps: NDArray[np.int64],  # (W,) since each world's reset; increased by 1
    horizon: int,  # steps of an episode
    results: Results,  # is written
) -> bool:  # whether the trip of some vehicle has ended
    """Write the agents' results of a step; `report_continuation` writes the other fields."""
    ended = False
    for w in range(steps.size):
        steps[w] += 1
        at_horizon = steps[w] >= horizon
        for agent in range(outputs.present.shape[1]):
            terminated = outputs.terminated[w, agent]
            acted = outputs.acted[w, agent]
            results.rewards[w, agent] = outputs.rewards[w, agent]
            results.vehicle_ids[w, agent] = outputs.vehicle_ids[w, agent]
            results.acted[w, agent] = acted
            results.terminations[w, agent] = terminated
            events = outputs.events[w, agent]
            cut = events & EVENTS_OF_FATE == 0 if terminated else at_horizon
            results.truncations[w, agent] = acted and cut
            results.vehicle_done[w, agent] = events & EVENTS_THAT_END != 0
            for k in range(outputs.terms.shape[2]):
                results.terms[w, agent, k] = outputs.terms[w, agent, k]
            ended |= terminated
    return ended


@kernel
def report_continuation(
    outputs: Outputs,  # of the step
    departures: DepartureQueue,  # waiting vehicles, and the number of arrivals
    steps: NDArray[np.int64],  # (W,) since each world's reset
    horizon: int,  # steps of an episode
    has_signals: bool,  # whether agents control signals; they stay until the horizon
    results: Results,  # is written
) -> bool:  # whether an episode is over
    """Write which agents act next and which episodes are over, after ended vehicles have left.

    An episode is over at its horizon, or when no agent is present and none waits to enter.
    """
    some_over = False
    for w in range(steps.size):
        results.arrivals[w] = departures.counts[w, COUNT_ARRIVED]
        goes_on = has_signals
        for agent in range(outputs.present.shape[1]):
            acts = outputs.present[w, agent] and not outputs.terminated[w, agent]
            results.mask[w, agent] = acts
            goes_on |= acts
        for n in range(departures.num_queue[w]):
            goes_on |= departures.queue[w, n]["agent"] >= 0
        over = steps[w] >= horizon or not goes_on
        results.episode_over[w] = over
        some_over |= over
    return some_over


@kernel
def keep_last(
    results: Results,  # which agents have ended, and which episodes are over
    # (W, A, D); set to 0 for agents that are gone, unless worlds reset in the next step
    observations: NDArray[np.float32],
    # (W, A, D) is written, in worlds where an agent or the episode has ended
    final_observations: NDArray[np.float32],
    in_next_step: bool,  # whether worlds reset in the next step
) -> None:
    """Keep the last observations of agents that have ended."""
    for w in range(observations.shape[0]):
        ended = results.episode_over[w]
        for agent in range(observations.shape[1]):
            ended |= results.terminations[w, agent]
        if not ended:
            continue
        for agent in range(observations.shape[1]):
            is_gone = results.terminations[w, agent] and not in_next_step
            for k in range(observations.shape[2]):
                final_observations[w, agent, k] = observations[w, agent, k]
                if is_gone:
                    observations[w, agent, k] = 0.0
