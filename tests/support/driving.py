"""Small seeded worlds for tests, with the built-in driver or without agents."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import ACTION_IDLE
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import load_world
from cavmarl.shards.shard import Commands
from tests.support.world import traffic_of


def make_simulation(
    env: str | Path,
    *,
    mode: str,
    agents: int = 1,
    background: int = 20,
    num_worlds: int = 1,
    overrides: Mapping[str, Any] | None = None,
) -> Simulation:
    """Make worlds of an environment with a population mode; the worlds are not reset."""
    config, network, demand, partition = load_world(
        env,
        agents=agents,
        background=background,
        overrides={"population.mode": mode, **(overrides or {})},
    )
    return Simulation(config, network, num_worlds, demand, partition)


def make_traffic(
    env: str | Path,
    *,
    background: int,
    num_worlds: int = 1,
    renewed: bool = True,
    overrides: Mapping[str, Any] | None = None,
) -> Simulation:
    """Make worlds without agents; with `renewed`, new vehicles replace arrived ones."""
    simulation = make_simulation(
        env, mode="respawn", background=background, num_worlds=num_worlds, overrides=overrides
    )
    traffic = traffic_of(simulation)
    vars(traffic)["demand"] = traffic.demand._replace(num_agents=0, reenter=renewed)
    return simulation


def start(simulation: Simulation, seed: int) -> None:
    """Reset the worlds with a seed."""
    simulation.seed(seed)
    simulation.reset()


def idle(simulation: Simulation) -> Commands:
    """Return commands without throttle and steering for all agents."""
    shape = simulation.outputs.present.shape
    return Commands(np.zeros((*shape, 2)), np.full(shape, ACTION_IDLE, dtype=np.int64))


def suggested(simulation: Simulation) -> NDArray[np.float64]:
    """Return (worlds, agents, 2): throttle in m/s² and steering in rad of the built-in driver."""
    raw = np.zeros((*simulation.outputs.present.shape, 2))
    simulation.suggest(raw)
    return raw


def drive(simulation: Simulation, noise: NDArray[np.float64] | float = 0.0) -> None:
    """Step with the suggested actions plus `noise`, and remove agents that have ended."""
    commands = idle(simulation)
    simulation.step(Commands(suggested(simulation) + noise, commands.meta_actions))
    simulation.retire_agents()
