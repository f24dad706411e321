"""`SharedOutputs`: the signals and the agents' outputs that all zones of a world share."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.compiled.bound_call import BoundCall, bind, keep_last
from cavmarl.core.huge_pages import huge_zeros
from cavmarl.core.memory import Zeros
from cavmarl.core.records.arrays import Outputs, SharedState
from cavmarl.engine.kernels.outputs import clear_outputs, settle_outputs
from cavmarl.roads.kernels.signal_phases import switch_signals
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.observed import frame_size


class SharedOutputs:
    """Signals and outputs of W worlds, and the phases that run once for all shards.

    Attributes:
        outputs: outputs of all agents; each shard writes at the indices of its own agents.
        chosen: (W,) the chosen worlds, which `clearing` and `settling` read.
    """

    def __init__(
        self,
        config: EnvConfig,
        network: RoadNetwork,  # the roads of the whole map
        num_worlds: int,  # W
        # (W, A, D) the array for the agents' observations; None: allocated here
        observations: NDArray[np.float32] | None = None,
        zeros: Zeros = huge_zeros,  # allocates all other outputs
    ) -> None:
        self.outputs = make_outputs(config, num_worlds, observations, zeros)
        self._roads = network.arrays
        self._sim_dt_s = config.clock.sim_dt_s
        self._weights = np.array(config.terms.weight_of_each)
        self._team = (config.terms.team_share, config.terms.team_range_m)
        self.has_signals = network.arrays.signals.size > 0
        self.chosen = np.ones(num_worlds, dtype=np.bool_)
        self.signal_switch = keep_last(self._bind_signal_switch)

    def _bind_signal_switch(self, common: SharedState) -> BoundCall[None]:
        return bind(
            switch_signals,
            roads=self._roads,
            keys=common.keys,
            ticks=common.ticks,
            detected_s=common.detected_s,
            dt=self._sim_dt_s,
            controllers=common.controllers,
            signal_phase=common.signal_phase,
        )

    @cached_property
    def clearing(self) -> BoundCall[None]:
        """The call that marks all agents as absent."""
        return bind(clear_outputs, outputs=self.outputs, chosen=self.chosen)

    @cached_property
    def settling(self) -> BoundCall[None]:
        """The call that sums rewards."""
        team_share, team_range_m = self._team
        return bind(
            settle_outputs,
            outputs=self.outputs,
            weights=self._weights,
            team_share=team_share,
            team_range_m=team_range_m,
            chosen=self.chosen,
        )

    def switch_signals(self, common: SharedState) -> None:
        """Switch the signals to the present tick, after `detect` of all shards."""
        if self.has_signals:
            self.signal_switch(common)()

    def clear_outputs(self, chosen: NDArray[np.bool_]) -> None:
        """Mark all agents of the chosen worlds (W,) as absent, before `sense` of all shards."""
        np.copyto(self.chosen, chosen)
        self.clearing()

    def settle_outputs(self, chosen: NDArray[np.bool_]) -> None:
        """Finish the outputs of the chosen worlds (W,) after `sense`, before `credit`."""
        np.copyto(self.chosen, chosen)
        self.settling()


def make_outputs(
    config: EnvConfig,
    num_worlds: int,  # W
    # (W, A, D) existing array; None: allocated here
    observations: NDArray[np.float32] | None = None,
    zeros: Zeros = np.zeros,  # allocates all other outputs
) -> Outputs:
    """Return the outputs of W empty worlds."""
    agents = (num_worlds, config.population.num_ids)
    if observations is None:
        size = config.sensors.stack * frame_size(config.sensors)
        # Not `zeros`, because NumPy requests huge pages only for arrays that it fills.
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
