"""`SharedOutputs`: signals and agents' outputs, which all zones of a world share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.compiled import specialized
from cavmarl.core.huge_pages import huge_zeros
from cavmarl.core.memory import Zeros
from cavmarl.core.records.arrays import Outputs, Worlds
from cavmarl.engine.kernels.outputs import clear_outputs, settle_outputs
from cavmarl.roads.kernels.signal_phases import switch_signals
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.observed import frame_size


class SharedOutputs:
    """What all shards of W worlds share, and the steps that are taken once for all of them.

    Attributes:
        outputs: of all agents; every shard writes at the indices of its own ones.
    """

    def __init__(
        self,
        config: EnvConfig,
        network: RoadNetwork,  # the roads of the whole map
        num_worlds: int,  # W
        # (W, A, D) where the agents' are written; None: made for them
        observations: NDArray[np.float32] | None = None,
        zeros: Zeros = huge_zeros,  # makes all other outputs
    ) -> None:
        self.outputs = make_outputs(config, num_worlds, observations, zeros)
        self._roads = network.arrays
        self._sim_dt_s = config.clock.sim_dt_s
        self._weights = np.array(config.terms.weight_of_each)
        self._team = (config.terms.team_share, config.terms.team_range_m)
        self._switch_signals = specialized(switch_signals)
        self._clear_outputs = specialized(clear_outputs)
        self._settle_outputs = specialized(settle_outputs)

    def switch_signals(self, worlds: Worlds) -> None:
        """Bring the signals to the present tick, after `detect` of all shards."""
        if self._roads.signals.size > 0:
            self._switch_signals(
                self._roads,
                worlds.keys,
                worlds.ticks,
                worlds.detected_s,
                self._sim_dt_s,
                worlds.controllers,
                worlds.signal_phase,
            )

    def clear_outputs(self, chosen: NDArray[np.bool_]) -> None:
        """Make all agents of the chosen worlds (W,) absent, before `sense` of all shards."""
        self._clear_outputs(self.outputs, chosen)

    def settle_outputs(self, chosen: NDArray[np.bool_]) -> None:
        """Finish the outputs of the chosen worlds (W,) after `sense`, before `credit`."""
        self._settle_outputs(self.outputs, self._weights, *self._team, chosen)


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
        places=zeros((*agents, 2), dtype=np.float64),
    )
