"""Speed of a traffic tick compared with libsumo: same map, demand and step length; no output.

Both sides run the demand up to the same second, then take turns of equal simulated length on the
same core: cavmarl in this process, SUMO in a separate process.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from cavmarl.bench.harness import (
    Say,
    Spread,
    check_range,
    one_core,
    silent,
    spread,
    take_turns,
)
from cavmarl.core.errors import ConfigError, require
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import find_map
from cavmarl.evaluate.traffic.native_side import idle_commands, make_world
from cavmarl.evaluate.traffic.sumo_side import SumoJob, start_sumo, sumo_process
from cavmarl.traffic.demand import DemandFile
from cavmarl.traffic.sumo.sumo_input import read_input

TURN_S = 10


@dataclass(frozen=True)
class TrafficSpeed:
    """Result of the comparison; rates are vehicle-steps per second of processor time."""

    map_name: str  # the map's name
    dt_s: float  # step length of both sides
    after_s: int  # simulated seconds before the first turn
    repeats: int  # turns of each side
    our_vehicles: float  # mean number of vehicles in cavmarl's world over all turns
    sumo_vehicles: float  # mean number of vehicles in SUMO's world over all turns
    ours: Spread  # rates of cavmarl
    sumo: Spread  # rates of libsumo
    ratio: float  # cavmarl's median over libsumo's


@dataclass(frozen=True)
class Turn:
    """One turn: number of vehicles times steps, processor time and wall-clock time."""

    vehicle_steps: int
    cpu_s: float
    wall_s: float


def measure_traffic_speed(
    map_name: str | Path,
    demand: Sequence[Path],
    *,
    dt_s: float = 0.1,
    seed: int = 0,
    after_s: int = 120,
    repeats: int = 5,
    progress: Say = silent,
) -> TrafficSpeed:
    """Measure both sides in turn on one core."""
    check_range(after=(after_s, 1, 3600), repeats=(repeats, 1, 100))
    path = find_map(map_name)
    given = read_input(demand)
    # Start with cavmarl, since its errors name file and line of unsupported demand.
    simulation = make_world(path, demand, after_s + repeats * TURN_S, seed, dt_s)
    if isinstance(simulation.demand, DemandFile):
        given = replace(given, begin_s=simulation.demand.begin_ms / 1000.0)
    job = SumoJob(path, given, after_s, dt_s, seed)
    warm, steps = round(after_s / dt_s), round(TURN_S / dt_s)
    with one_core(), tempfile.TemporaryDirectory() as folder, sumo_process(job) as sumo:
        progress(f"SUMO's first {after_s} s")
        sumo.submit(load_sumo, job, folder).result()
        sumo.submit(turn_of_sumo, warm).result()
        progress(f"cavmarl's first {after_s} s")
        our_turn(simulation, warm)
        sides: dict[str, Callable[[], Turn]] = {
            "ours": partial(our_turn, simulation, steps),
            "sumo": lambda: sumo.submit(turn_of_sumo, steps).result(),
        }
        turns = take_turns(sides, repeats, progress)
    rates = {
        name: spread(turn.vehicle_steps / turn.cpu_s for turn in own) for name, own in turns.items()
    }
    if not rates["sumo"].median > 0.0:
        raise ConfigError(f"no vehicle drives after {after_s} s: change --after, or add demand")
    our_vehicles, sumo_vehicles = (
        sum(turn.vehicle_steps for turn in turns[name]) / (repeats * steps) for name in sides
    )
    return TrafficSpeed(
        simulation.network.name,
        dt_s,
        after_s,
        repeats,
        our_vehicles,
        sumo_vehicles,
        **rates,
        ratio=rates["ours"].median / rates["sumo"].median,
    )


def _timed(steps: int, step: Callable[[], int]) -> Turn:
    """Time a number of steps; `step` returns the number of moved vehicles."""
    began, began_s = time.perf_counter(), time.process_time()
    vehicle_steps = sum(step() for _ in range(steps))
    return Turn(vehicle_steps, time.process_time() - began_s, time.perf_counter() - began)


def our_turn(simulation: Simulation, steps: int) -> Turn:
    """Time some steps of a world."""
    commands = idle_commands(simulation)

    def step() -> int:
        simulation.step(commands)
        return len(simulation.vehicles())

    return _timed(steps, step)


def load_sumo(job: SumoJob, folder: str) -> None:
    """Load the job into the process that runs SUMO; libsumo keeps it in this process."""
    start_sumo(job, Path(folder))


def turn_of_sumo(steps: int) -> Turn:
    """Time some steps of the SUMO simulation that is loaded in this process."""
    libsumo = require("libsumo", "sumo")

    def step() -> int:
        libsumo.simulationStep()
        return int(libsumo.vehicle.getIDCount())

    return _timed(steps, step)
