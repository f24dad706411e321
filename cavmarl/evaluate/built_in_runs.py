"""Worlds with any number of zones in which the built-in driver drives all agents."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Unpack

import numpy as np

from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import find_map, load_world
from cavmarl.env.actions import ActionDecoder
from cavmarl.evaluate.traffic.native_side import load_demand
from cavmarl.shards.shard import Commands
from cavmarl.zones.partition.zone_file import named_zones

TICK_S = 0.1  # tick of a world with demand, in s
UNDIVIDED = "bisection"  # with one zone, all layouts are equal


class DrivenWorld:
    """A world whose agents act as the built-in driver does."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self._num_agents = simulation.config.population.num_ids
        names = [str(agent) for agent in range(self._num_agents)]
        self._decoder = ActionDecoder(simulation.config.action, 1, names)

    def commands(self) -> Commands:
        if not self._num_agents:
            return self._decoder.idle()
        outputs = self.simulation.outputs
        raw = np.zeros((*outputs.present.shape, 2))
        self.simulation.suggest(raw)
        acting = outputs.present & ~outputs.terminated
        return self._decoder.from_array(self._decoder.encode(raw), acting)

    def step(self, commands: Commands) -> None:
        """Take one step; agents whose trip has ended are removed afterwards."""
        self.simulation.step(commands)
        if self._num_agents:
            self.simulation.retire_agents()


def world_maker(
    env: str | Path | WorldSpec,
    demand: Sequence[Path] = (),
    *,
    layout: str = UNDIVIDED,
    seconds: int,
    **keys: Unpack[WorldKeys],
) -> Callable[[int], Simulation]:
    """Return a function that makes the same world with k zones, already reset.

    Args:
        env: as in `make_vec`, like the other keywords.
        demand: demand that replaces the environment's vehicles, with ticks of `TICK_S`.
        layout: shape of the zones, or a zone file.
        seconds: length of the episode in s.
        keys: keys of the world; with `demand`, numbers of vehicles are ignored.
    """
    spec = WorldSpec.of(env, **keys)
    if demand:
        world = load_demand(find_map(spec.env), demand, seconds, TICK_S, spec.overrides)
    else:
        lasting = {"horizon_s": float(seconds), **spec.overrides}
        world = load_world(spec.env, **spec.keywords | {"overrides": lasting})
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
        simulation.seed(spec.seed)
        simulation.reset()
        return simulation

    return make
