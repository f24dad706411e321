"""What concerns the outputs of all agents at once, whichever shards own them.

The order at the end of a step: `clear_outputs`, `sense` of every shard, `settle_outputs`, `credit`
of every shard. Sums go in agent order, so that results do not depend on which shard wrote what.

Observations can hold the last few frames, one after the other, oldest first, and in each frame what
the vehicle did before. That of an agent stands in the output arrays at its index and nowhere else,
so a carrier of the outputs of an agent carries its past.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import Outputs, Worlds
from cavmarl.core.records.codes import DRIVER_AGENT


@kernel
def has_entered(row: np.void, ticks_per_step: int) -> bool:
    """Whether a vehicle entered during the last step, at reset too."""
    return bool(row["departed"] > row["tick"] - ticks_per_step)


@kernel
def newest_frame(observation: NDArray[np.float32], stack: int) -> int:
    return observation.size - observation.size // stack


@kernel
def shift_frames(observation: NDArray[np.float32], stack: int, kept_at: int, kept: int) -> None:
    """Move the frames up and clear the newest, but for `kept` numbers from `kept_at` on."""
    newest = newest_frame(observation, stack)
    size = observation.size - newest
    for k in range(newest):
        observation[k] = observation[k + size]
    observation[newest : newest + kept_at] = 0.0
    observation[newest + kept_at + kept :] = 0.0


@kernel
def repeat_frame(observation: NDArray[np.float32], stack: int) -> None:
    """Make all frames the newest one: what an agent sees that has just entered."""
    newest = newest_frame(observation, stack)
    size = observation.size - newest
    for k in range(newest):
        observation[k] = observation[newest + k % size]


@kernel
def fill_stacks(
    worlds: Worlds,
    ticks_per_step: int,
    stack: int,
    chosen: NDArray[np.bool_],
    observations: NDArray[np.float32],
) -> None:
    """Repeat the first frame of every vehicle that entered during the last step.

    `observations`: (W, A, D) with the newest frames complete.
    """
    for w in range(chosen.size):
        if not chosen[w]:
            continue
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if row["driver"] == DRIVER_AGENT and has_entered(row, ticks_per_step):
                repeat_frame(observations[w, row["agent"]], stack)


@kernel
def clear_outputs(outputs: Outputs, chosen: NDArray[np.bool_]) -> None:
    """Make all agents of the chosen worlds (W,) absent; the observations stay for the stacks."""
    for w in range(chosen.size):
        if not chosen[w]:
            continue
        outputs.terms[w] = 0.0
        outputs.rewards[w] = 0.0
        outputs.terminated[w] = False
        outputs.present[w] = False
        outputs.acted[w] = False
        outputs.events[w] = 0
        outputs.vehicle_ids[w] = -1


@kernel
def settle_outputs(
    outputs: Outputs,
    weights: NDArray[np.float64],
    team_share: float,
    team_range_m: float,
    chosen: NDArray[np.bool_],
) -> None:
    """Finish the outputs that all shards have written.

    `outputs`: rewards are written, and the observations of absent agents become 0. `weights`: (T,)
    of the reward, a number for each term. `team_share`: share of the reward that is the mean over
    the agents that acted, `team_range_m`: and are so near; 0: over all.
    """
    for w in range(chosen.size):
        if chosen[w]:
            _zero_absent(outputs, w)
            if team_range_m > 0.0:
                _share_near(outputs, w, weights, team_share, team_range_m)
            else:
                _share_all(outputs, w, weights, team_share)


@kernel
def _zero_absent(outputs: Outputs, w: int) -> None:
    for agent in range(outputs.present.shape[1]):
        if not outputs.present[w, agent]:
            outputs.observations[w, agent] = 0.0


@kernel
def _own_reward(outputs: Outputs, w: int, agent: int, weights: NDArray[np.float64]) -> float:
    """The weighted sum of an agent's terms."""
    own = 0.0
    for k in range(weights.size):
        own += weights[k] * outputs.terms[w, agent, k]
    return own


@kernel
def _share_all(outputs: Outputs, w: int, weights: NDArray[np.float64], team_share: float) -> None:
    """Own rewards, mixed with the team's mean; summed in agent order."""
    team = 0.0
    acted = 0
    for agent in range(outputs.rewards.shape[1]):
        if outputs.acted[w, agent]:
            own = _own_reward(outputs, w, agent, weights)
            outputs.rewards[w, agent] = own
            team += own
            acted += 1
    if acted == 0:
        return
    team /= acted
    for agent in range(outputs.rewards.shape[1]):
        if outputs.acted[w, agent]:
            own = outputs.rewards[w, agent]
            outputs.rewards[w, agent] = (1.0 - team_share) * own + team_share * team


@kernel
def _share_near(
    outputs: Outputs, w: int, weights: NDArray[np.float64], team_share: float, range_m: float
) -> None:
    """Own rewards, mixed with the mean of those near, itself too; summed in agent order."""
    for agent in range(outputs.rewards.shape[1]):
        if not outputs.acted[w, agent]:
            continue
        x, y = outputs.places[w, agent, 0], outputs.places[w, agent, 1]
        team = 0.0
        near = 0
        for other in range(outputs.rewards.shape[1]):
            if outputs.acted[w, other]:
                dx = outputs.places[w, other, 0] - x
                dy = outputs.places[w, other, 1] - y
                if dx * dx + dy * dy <= range_m * range_m:
                    team += _own_reward(outputs, w, other, weights)
                    near += 1
        own = _own_reward(outputs, w, agent, weights)
        outputs.rewards[w, agent] = (1.0 - team_share) * own + team_share * (team / near)


@kernel
def credit(
    rows: NDArray[np.void],
    num_owned: NDArray[np.int64],
    rewards: NDArray[np.float32],
    chosen: NDArray[np.bool_],
) -> None:
    """Add the rewards of the step to what owned agents have got in their episode.

    `rows`: VEHICLE (W, C); episode_return of agents' rows is written. `num_owned`: (W,) rows of the
    shard's own. `rewards`: (W, A).
    """
    for w in range(chosen.size):
        if not chosen[w]:
            continue
        for i in range(num_owned[w]):
            row = rows[w, i]
            if row["driver"] == DRIVER_AGENT:
                row["episode_return"] += rewards[w, row["agent"]]
