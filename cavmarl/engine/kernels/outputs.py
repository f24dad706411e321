"""The outputs of all agents of a world, independent of the shards that own them.

The order at the end of a step is `clear_outputs`, `sense` of every shard, `settle_outputs`,
`credit` of every shard (`engine.tick`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import Outputs
from cavmarl.rewards.kernels.reward import write_rewards


@kernel
def clear_outputs(outputs: Outputs, chosen: NDArray[np.bool_]) -> None:
    """Mark all agents of the chosen worlds (W,) as absent, but keep observations for stacks."""
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
def _zero_absent(outputs: Outputs, w: int) -> None:
    for agent in range(outputs.present.shape[1]):
        if not outputs.present[w, agent]:
            outputs.observations[w, agent] = 0.0


@kernel
def settle_outputs(
    outputs: Outputs,
    weights: NDArray[np.float64],
    team_share: float,
    team_range_m: float,
    chosen: NDArray[np.bool_],
) -> None:
    """Finish the outputs that all shards have written, in the chosen worlds (W,).

    Set the observations of absent agents to 0, and write rewards with `write_rewards`.
    """
    for w in range(chosen.size):
        if chosen[w]:
            _zero_absent(outputs, w)
            write_rewards(outputs, w, weights, team_share, team_range_m)
