"""A run of a demand in cavmarl, measured like SUMO's run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cavmarl.core.records.codes import ACTION_IDLE
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import World, load_world
from cavmarl.evaluate.traffic.traffic_metrics import TrafficCounts, TrafficMeter, TrafficRun
from cavmarl.roads.shown_signals import signal_codes
from cavmarl.shards.shard import Commands
from cavmarl.traffic.sumo.sumo_input import read_input


def load_demand(
    map_file: Path,
    demand: Sequence[Path],
    seconds: int,
    dt_s: float,
    overrides: Mapping[str, Any] | None = None,
) -> World:
    """Return the parts of a world with background traffic and no agents, with ticks of `dt_s`.

    Signal programs in additional files of the demand are used, too.
    """
    own = {
        "clock.sim_dt_s": dt_s,
        "clock.ctrl_dt_s": dt_s,
        "horizon_s": float(seconds),
        "traffic.demand": [str(path.resolve()) for path in demand],
        "map.programs": [str(path) for path in read_input(demand).additional_files],
    }
    return load_world(map_file, agents=0, background=0, overrides={**own, **(overrides or {})})


def make_world(
    map_file: Path, demand: Sequence[Path], seconds: int, seed: int, dt_s: float
) -> Simulation:
    config, network, file, partition = load_demand(map_file, demand, seconds, dt_s)
    simulation = Simulation(config, network, demand=file, partition=partition)
    simulation.seed(seed)
    simulation.reset()
    return simulation


def idle_commands(simulation: Simulation) -> Commands:
    """Return the commands of a step without actions."""
    shape = simulation.outputs.present.shape
    return Commands(np.zeros((*shape, 2)), np.full(shape, ACTION_IDLE, dtype=np.int64))


def run_native(
    simulation: Simulation,
    seconds: int,
    after_tick: Callable[[Simulation], None] = lambda simulation: None,
) -> TrafficRun:
    """Run and measure a world without agents; a second must be a whole number of steps.

    `after_tick` is called with the world after each tick.
    """
    meter = TrafficMeter(simulation.network)
    commands = idle_commands(simulation)
    ticks_per_s = round(1.0 / simulation.config.clock.sim_dt_s)
    ticks_per_step = simulation.config.clock.ticks_per_step
    for tick in range(1, seconds * ticks_per_s + 1):
        if ticks_per_step == 1:
            simulation.step(commands)
        else:
            simulation.run_tick(commands, tick % ticks_per_step == 1, tick % ticks_per_step == 0)
        after_tick(simulation)
        rows = simulation.vehicles()
        meter.see(rows)
        if tick % ticks_per_s == 0:
            meter.sample(rows, signal_codes(simulation.network, simulation.signal_phases()))
    stats = simulation.traffic_stats()
    delay = stats.mean_delay_s if stats.arrived else None
    return meter.result(TrafficCounts(stats.departed, stats.waiting, stats.arrived, delay))
