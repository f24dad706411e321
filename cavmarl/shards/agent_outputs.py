"""The arrays in which all agents of W worlds get what they sense, whichever shards own them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.memory import Zeros
from cavmarl.core.records.arrays import Outputs
from cavmarl.sensors.observed import frame_size


def make_outputs(
    config: EnvConfig,
    num_worlds: int,  # W
    observations: NDArray[np.float32] | None = None,  # (W, A, D) to be used; None: they are made
    zeros: Zeros = np.zeros,  # makes all others
) -> Outputs:
    """Outputs of W empty worlds."""
    agents = (num_worlds, config.population.num_ids)
    if observations is None:
        size = config.sensors.stack * frame_size(config.sensors)
        # Not `zeros`: NumPy asks for huge pages where it fills the array itself.
        observations = np.full((*agents, size), 0.0, dtype=np.float32)
    vehicle_ids = zeros(agents, dtype=np.int64)
    vehicle_ids[...] = -1
    return Outputs(
        observations=observations,
        terms=zeros((*agents, len(config.terms.names)), dtype=np.float32),
        rewards=zeros(agents, dtype=np.float32),
        terminated=zeros(agents, dtype=np.bool_),
        present=zeros(agents, dtype=np.bool_),
        acted=zeros(agents, dtype=np.bool_),
        events=zeros(agents, dtype=np.int32),
        vehicle_ids=vehicle_ids,
    )
