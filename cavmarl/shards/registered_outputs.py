"""What agents get from sensors and terms that are registered from outside of the package."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import TERMS, EnvConfig
from cavmarl.core.extensions import REGISTERED_SENSORS, REGISTERED_TERMS
from cavmarl.core.records.arrays import Outputs, Worlds
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.driving.agent_view import RegisteredFunction, agent_view
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.kernels.output_reset import newest_frame
from cavmarl.sensors.observed import layout


class RegisteredOutputs:
    """Asks the registered sensors and terms of a configuration."""

    def __init__(self, config: EnvConfig, network: RoadNetwork) -> None:
        self._network = network
        self._stack = config.sensors.stack
        self._step_s = config.clock.sim_dt_s * config.clock.ticks_per_step
        places = layout(config.sensors)
        self._sensors = []
        for name in config.sensors.registered:
            sensor, place = REGISTERED_SENSORS[name], places[name]
            call = RegisteredFunction(name, sensor.sense, place.stop - place.start)
            self._sensors.append((call, sensor.reach_m(config.sensors), place))
        self._terms = []
        for column, name in enumerate(config.terms.registered, len(TERMS)):
            term = REGISTERED_TERMS[name]
            self._terms.append((RegisteredFunction(name, term.function, 1), term.reach_m, column))

    def write(self, worlds: Worlds, chosen: NDArray[np.bool_], outputs: Outputs) -> None:
        """Write those of every owned agent of the chosen worlds (W,), after `sense`."""
        if not self._sensors and not self._terms:
            return
        for w in np.flatnonzero(chosen).tolist():
            rows = worlds.rows[w, : worlds.num_rows[w]]
            owned = rows["driver"][: worlds.num_owned[w]] == DRIVER_AGENT
            for i in np.flatnonzero(owned).tolist():
                self._write_agent(rows, i, w, outputs)

    def _write_agent(self, rows: NDArray[np.void], i: int, w: int, outputs: Outputs) -> None:
        agent = int(rows["agent"][i])
        seen = outputs.observations[w, agent]
        frame = seen[newest_frame(seen, self._stack) :]
        for call, reach_m, place in self._sensors:
            frame[place] = call(agent_view(rows, i, reach_m, self._network, self._step_s))
        if not outputs.acted[w, agent]:
            return
        for call, reach_m, column in self._terms:
            view = agent_view(rows, i, reach_m, self._network, self._step_s)
            outputs.terms[w, agent, column] = call(view)[0]
