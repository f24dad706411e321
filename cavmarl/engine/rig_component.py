"""`RigComponent`: the sensor rigs of all agents as a `Component`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.population import PopulationConfig
from cavmarl.driving.vehicle_types import agent_types
from cavmarl.engine.component import Component, ComponentContext
from cavmarl.sensors.mounted.backdrop import make_backdrop
from cavmarl.sensors.mounted.mounted_sensor import Platform, SensedScene
from cavmarl.sensors.mounted.sensor_rig import Rig
from cavmarl.shards.shard import Commands


class RigComponent(Component):
    """Takes the samples of all agents' rigs in each tick.

    Attributes:
        platform: the vehicles that carry the sensors.
    """

    def __init__(self, host: ComponentContext) -> None:
        config = host.config
        self.platform = Platform(
            network=host.network,
            bodies=_bodies(config.population),
            population=config.population,
            num_worlds=host.num_worlds,
            num_agents=config.population.num_ids,
            sim_dt_s=config.clock.sim_dt_s,
            ticks_per_step=config.clock.ticks_per_step,
            capacity=host.shards[0].worlds.rows.shape[1],
            backdrop=make_backdrop(host.network, host.travel.types),
        )
        ids = host.zeros((host.num_worlds, config.population.num_ids), dtype=np.int64)
        ids[...] = -1
        self._host = host
        self.rig = Rig(config.rig, self.platform, host.frames, ids)

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Take the samples that are due at the reset of the chosen worlds (W,)."""
        self.rig.reset(self.scenes(), chosen)

    def begin(self, commands: Commands) -> None:
        self.rig.begin(self.scenes())

    def end(self) -> None:
        self.rig.end(self.scenes())

    def arrays(self) -> Iterator[NDArray[Any]]:
        return self.rig.arrays()

    def scenes(self) -> list[SensedScene]:
        """Return the present surroundings of the agents of each zone."""
        return [
            SensedScene(
                roads=shard.roads,
                lane_grid=shard.lane_grid,
                plans=shard.plans,
                travel=shard.travel,
                worlds=shard.worlds,
                grid=shard.grid,
                before=self.rig.before,
            )
            for shard in self._host.shards
        ]


def _bodies(population: PopulationConfig) -> NDArray[np.void]:
    """Return VTYPE (A,) of the agents' vehicles."""
    rows = {name: row for row, name in enumerate(dict.fromkeys(population.agent_types))}
    chosen = np.array([rows[name] for name in population.agent_types], dtype=np.int64)
    return agent_types(rows, own=population.own_types)[np.resize(chosen, population.num_ids)]
