"""Makes worlds divided into any number of zones, with the built-in driver for all agents."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import find_map, load_world
from cavmarl.env.actions import ActionDecoder
from cavmarl.evaluate.traffic.native_side import load_demand
from cavmarl.shards.shard import Commands
from cavmarl.zones.partition.zone_file import named_zones

TICK_S = 0.1  # of a world of demand
UNDIVIDED = "bisection"  # of one zone: all layouts are the same


class DrivenWorld:
    """A world whose agents do what the built-in driver would.

    Args:
        simulation: one world, reset.
    """

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self._num_agents = simulation.config.population.num_ids
        names = [str(agent) for agent in range(self._num_agents)]
        self._decoder = ActionDecoder(simulation.config.action, 1, names)

    def commands(self) -> Commands:
        """Of the next step."""
        if not self._num_agents:
            return self._decoder.idle()
        outputs = self.simulation.outputs
        raw = np.zeros((*outputs.present.shape, 2))
        self.simulation.suggest(raw)
        acting = outputs.present & ~outputs.terminated
        return self._decoder.from_array(self._decoder.encode(raw), acting)

    def step(self, commands: Commands) -> None:
        """One step; agents whose trip has ended are gone after it."""
        self.simulation.step(commands)
        if self._num_agents:
            self.simulation.retire_agents()


def world_maker(
    env: str | Path,
    demand: Sequence[Path] = (),
    *,
    layout: str = UNDIVIDED,
    seconds: int,
    seed: int = 0,
    agents: int | None = None,
    background: int | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Callable[[int], Simulation]:
    """What makes the same world in k zones, reset.

    Args:
        env: name, folder or map file of an environment.
        demand: what drives on its map instead of the environment's vehicles, ticks of `TICK_S`.
        layout: how zones are cut, or a zone file.
        seconds: how long the world is needed.
        seed: root of all random numbers.
        agents: of a world without `demand`; default: the environment's.
        background: the same.
        overrides: values for other keys.

    Raises:
        ConfigError: a key, a value or a demand that cannot work.
        DemandError: a demand that cannot be, or not on this map.
        MapError: the map cannot be driven.
    """
    if demand:
        world = load_demand(find_map(env), demand, seconds, TICK_S, overrides)
    else:
        world = load_world(
            env,
            agents=agents,
            background=background,
            overrides={"horizon_s": float(seconds), **(overrides or {})},
        )
    config, network, file, _ = world

    def make(zones: int) -> Simulation:
        partition = named_zones(
            network,
            layout if zones > 1 else UNDIVIDED,
            zones,
            avoid_junctions=config.zones.avoid_junctions,
            weight=config.zones.weight,
        )
        simulation = Simulation(config, network, demand=file, partition=partition)
        simulation.seed(seed)
        simulation.reset()
        return simulation

    return make
