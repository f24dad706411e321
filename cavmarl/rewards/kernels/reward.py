"""The reward of each agent: the weighted sum of its terms, the team's share, and the credit.

The rewards of all agents of a world are computed at once and in agent order, so that no result
depends on which shard wrote which terms.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import Outputs
from cavmarl.core.records.codes import DRIVER_AGENT


@kernel
def _own_reward(outputs: Outputs, w: int, agent: int, weights: NDArray[np.float64]) -> float:
    """Return the weighted sum of an agent's terms."""
    own = 0.0
    for k in range(weights.size):
        own += weights[k] * outputs.terms[w, agent, k]
    return own


@kernel
def _share_all(outputs: Outputs, w: int, weights: NDArray[np.float64], team_share: float) -> None:
    """Write own rewards mixed with the mean of all agents, summed in agent order."""
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
    """Write own rewards mixed with the mean of agents within range, including the agent itself."""
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
def write_rewards(
    outputs: Outputs,
    w: int,
    weights: NDArray[np.float64],
    team_share: float,
    team_range_m: float,
) -> None:
    """Write the rewards of the agents of world `w` that acted.

    `weights`: (T,) weight of each term. `team_share`: share of the team's mean in a reward.
    `team_range_m`: only agents within this distance belong to the team; 0: all agents.
    """
    if team_range_m > 0.0:
        _share_near(outputs, w, weights, team_share, team_range_m)
    else:
        _share_all(outputs, w, weights, team_share)


@kernel
def credit(
    rows: NDArray[np.void],
    num_owned: NDArray[np.int64],
    rewards: NDArray[np.float32],
    chosen: NDArray[np.bool_],
) -> None:
    """Add the rewards of the step to the episode return of each owned agent.

    `rows`: VEHICLE (W, C); episode_return of agents' rows is written. `num_owned`: (W,) number of
    the shard's owned rows. `rewards`: (W, A).
    """
    for w in range(chosen.size):
        if not chosen[w]:
            continue
        for i in range(num_owned[w]):
            row = rows[w, i]
            if row["driver"] == DRIVER_AGENT:
                row["episode_return"] += rewards[w, row["agent"]]
