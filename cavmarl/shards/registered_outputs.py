"""Outputs of sensors and terms that are registered outside of the package."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.terms import TERMS
from cavmarl.core.extensions import REGISTERED_SENSORS, REGISTERED_TERMS
from cavmarl.core.records.arrays import Outputs, Worlds
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.driving.agent_view import RegisteredFunction, batch_view
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.kernels.frame_stacks import newest_frame
from cavmarl.sensors.observed import layout


class RegisteredOutputs:
    """Calls the registered sensors and terms of a configuration."""

    def __init__(self, config: EnvConfig, network: RoadNetwork) -> None:
        self._network = network
        self._may_change = config.map.changed_lanes > 0
        self._networks: dict[int, RoadNetwork] = {}  # world → its roads, if lanes may change
        self._stack = config.sensors.stack
        self._step_s = config.clock.sim_dt_s * config.clock.ticks_per_step
        places = layout(config.sensors)
        self._sensors = []
        for name in config.sensors.registered:
            sensor, place = REGISTERED_SENSORS[name], places[name]
            size = place.stop - place.start
            call = RegisteredFunction(name, sensor.sense, size, sensor.batched)
            self._sensors.append((call, sensor.reach_m(config.sensors), place))
        self._terms = []
        for column, name in enumerate(config.terms.registered, len(TERMS)):
            term = REGISTERED_TERMS[name]
            call = RegisteredFunction(name, term.function, 1, term.batched)
            self._terms.append((call, term.reach_m, column))

    @property
    def is_empty(self) -> bool:
        """Whether the configuration has no registered sensors or terms."""
        return not self._sensors and not self._terms

    def write(self, worlds: Worlds, chosen: NDArray[np.bool_], outputs: Outputs) -> None:
        """Write the outputs of all owned agents in the chosen worlds (W,), after `sense`."""
        if self.is_empty:
            return
        for w in np.flatnonzero(chosen).tolist():
            rows = worlds.rows[w, : worlds.num_rows[w]]
            owned = rows["driver"][: worlds.num_owned[w]] == DRIVER_AGENT
            if owned.any():
                network = self._network_of(worlds, w)
                self._write_agents(network, rows, np.flatnonzero(owned), w, outputs)

    def _network_of(self, worlds: Worlds, w: int) -> RoadNetwork:
        """Return the roads of a world, with its current lanes."""
        if not self._may_change:
            return self._network
        if w not in self._networks:
            self._networks[w] = replace(self._network, lanes=worlds.lanes[1 + w])
        return self._networks[w]

    def _write_agents(
        self,
        network: RoadNetwork,
        rows: NDArray[np.void],
        agent_arrays: NDArray[np.int64],
        w: int,
        outputs: Outputs,
    ) -> None:
        """Write the outputs of the agents whose vehicles are the rows `agent_arrays`."""
        agents = rows["agent"][agent_arrays]
        for call, reach_m, place in self._sensors:
            view = batch_view(rows, agent_arrays, reach_m, network, self._step_s)
            numbers = call(view)
            for agent, own in zip(agents.tolist(), numbers, strict=True):
                seen = outputs.observations[w, agent]
                seen[newest_frame(seen, self._stack) :][place] = own
        acted = outputs.acted[w, agents]
        if acted.any():
            for call, reach_m, column in self._terms:
                chosen = agent_arrays[acted]
                numbers = call(batch_view(rows, chosen, reach_m, network, self._step_s))
                outputs.terms[w, agents[acted], column] = numbers[:, 0]
