"""How fast a tick of traffic is, next to libsumo's: same map, demand, step length; no output.

Both sides run the demand up to the same second, then take turns of the same simulated length, ours
in this process and SUMO in one of its own, on the same core.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

from cavmarl.bench.step_speed import one_core
from cavmarl.core.errors import ConfigError, require
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import find_map
from cavmarl.evaluate.traffic.native_side import advance, idle_commands, make_world
from cavmarl.evaluate.traffic.sumo_side import SumoJob, start_sumo, sumo_process
from cavmarl.traffic.sumo.sumo_input import read_input

__all__ = ["Rates", "TrafficSpeed", "measure_traffic_speed"]

TURN_S = 10
MAX_AFTER_S = 3600
MAX_REPEATS = 100


@dataclass(frozen=True)
class Rates:
    """Vehicle-steps a second: slowest turn, median, fastest turn."""

    low: float
    median: float
    high: float


@dataclass(frozen=True)
class TrafficSpeed:
    """Result of the comparison; rates are vehicle-steps a second of the processor's time.

    Attributes:
        map_name: the map's name.
        dt_s: step length of both.
        after_s: simulated seconds before the first turn.
        repeats: turns of each.
        our_vehicles: mean number in our world over all turns.
        sumo_vehicles: the same in SUMO's.
        ours: our rates.
        sumo: libsumo's.
        ratio: of the medians, ours over libsumo's.
    """

    map_name: str
    dt_s: float
    after_s: int
    repeats: int
    our_vehicles: float
    sumo_vehicles: float
    ours: Rates
    sumo: Rates
    ratio: float

    def to_dict(self) -> dict[str, Any]:
        """As plain types, for JSON."""
        return asdict(self)


def measure_traffic_speed(
    map_name: str | Path,
    demand: Sequence[Path],
    *,
    dt_s: float = 0.1,
    seed: int = 0,
    after_s: int = 120,
    repeats: int = 5,
    progress: Callable[[str], None] = lambda text: None,
) -> TrafficSpeed:
    """Measure by turns on one core.

    Args:
        map_name: an environment's name or folder, or a map file.
        demand: files of routes and additional files, or one `.sumocfg`.
        dt_s: step length of both.
        seed: of both.
        after_s: simulated seconds before the first turn.
        repeats: turns of each, of 10 simulated seconds.
        progress: told what is going on.

    Raises:
        ConfigError: a number, a demand, or a demand on this map that cannot work; nobody drives.
        MapError: the map cannot be read or driven.
        MissingExtraError: SUMO is not installed.
    """
    for name, value, most in (("after", after_s, MAX_AFTER_S), ("repeats", repeats, MAX_REPEATS)):
        if not 1 <= value <= most:
            raise ConfigError(f"{name} = {value}: must be from 1 to {most}")
    path = find_map(map_name)
    job = SumoJob(path, read_input(demand), after_s, dt_s, seed)
    warm, steps = round(after_s / dt_s), round(TURN_S / dt_s)
    turns: dict[str, list[_Turn]] = {"ours": [], "sumo": []}
    with (
        one_core(),
        tempfile.TemporaryDirectory() as folder,
        sumo_process(job) as sumo,
    ):
        # Ours first: it names file and line of what neither can drive.
        simulation = make_world(path, demand, after_s + repeats * TURN_S, seed, dt_s)
        progress(f"SUMO's first {after_s} s")
        sumo.submit(_load_sumo, job, folder).result()
        sumo.submit(_turn_of_sumo, warm).result()
        progress(f"our first {after_s} s")
        _our_turn(simulation, warm)
        for repeat in range(repeats):
            progress(f"measuring, {repeat + 1} of {repeats}")
            turns["ours"].append(_our_turn(simulation, steps))
            turns["sumo"].append(sumo.submit(_turn_of_sumo, steps).result())
    rates = {name: _rates(own) for name, own in turns.items()}
    vehicles = {
        name: sum(turn.vehicle_steps for turn in own) / (repeats * steps)
        for name, own in turns.items()
    }
    if not rates["sumo"].median > 0.0:
        raise ConfigError(f"nobody drives after {after_s} s: another --after, or more demand")
    return TrafficSpeed(
        map_name=simulation.network.name,
        dt_s=dt_s,
        after_s=after_s,
        repeats=repeats,
        our_vehicles=vehicles["ours"],
        sumo_vehicles=vehicles["sumo"],
        ours=rates["ours"],
        sumo=rates["sumo"],
        ratio=rates["ours"].median / rates["sumo"].median,
    )


@dataclass(frozen=True)
class _Turn:
    vehicle_steps: int
    cpu_s: float


def _rates(turns: list[_Turn]) -> Rates:
    rates = [turn.vehicle_steps / turn.cpu_s for turn in turns]
    return Rates(min(rates), median(rates), max(rates))


def _our_turn(simulation: Simulation, steps: int) -> _Turn:
    commands = idle_commands(simulation)
    vehicle_steps = 0
    began = time.process_time()
    for _ in range(steps):
        advance(simulation, commands)
        vehicle_steps += len(simulation.vehicles())
    return _Turn(vehicle_steps, time.process_time() - began)


def _load_sumo(job: SumoJob, folder: str) -> None:
    """Load the job into the process that runs SUMO; libsumo keeps it there."""
    start_sumo(job, Path(folder))


def _turn_of_sumo(steps: int) -> _Turn:
    libsumo = require("libsumo", "sumo")
    vehicle_steps = 0
    began = time.process_time()
    for _ in range(steps):
        libsumo.simulationStep()
        vehicle_steps += libsumo.vehicle.getIDCount()
    return _Turn(vehicle_steps, time.process_time() - began)
