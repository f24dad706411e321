"""What SUMO as global traffic costs: libsumo alone, and a world that is coupled to one.

Both run the same demand with the same step length and seed up to the same second; then they take
turns of the same simulated length. Of the coupled world the time of both of its processes counts:
its SUMO's and its own, with all that goes between them.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal

from cavmarl.core.errors import ConfigError, require
from cavmarl.engine.world_setup import find_map
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.evaluate.traffic.sumo_side import SumoJob, start_sumo, sumo_process
from cavmarl.parallel.processes.watchdog import processor_s
from cavmarl.traffic.sumo.sumo_input import read_input

__all__ = ["Cost", "SumoSpeed", "measure_sumo_speed"]

TURN_S = 10
MAX_AFTER_S = 3600
MAX_REPEATS = 100


@dataclass(frozen=True)
class Cost:
    """Milliseconds a tick: fastest turn, median, slowest turn."""

    low: float
    median: float
    high: float


@dataclass(frozen=True)
class SumoSpeed:
    """Result of the comparison.

    Attributes:
        map_name: the map's name.
        source: how the world is coupled.
        dt_s: step length of both.
        after_s: simulated seconds before the first turn.
        repeats: turns of each.
        agents: vehicles of the coupled world that are driven from outside.
        sumo_vehicles: mean number in libsumo alone.
        our_vehicles: mean number in the coupled world, agents included.
        sumo: processor time of libsumo alone.
        coupled: processor time of the coupled world, both processes.
        sumo_wall: the same by the wall clock.
        coupled_wall: the same by the wall clock.
        added: what coupling adds over what libsumo takes, processor time, of the medians.
        added_wall: the same by the wall clock.
    """

    map_name: str
    source: str
    dt_s: float
    after_s: int
    repeats: int
    agents: int
    sumo_vehicles: float
    our_vehicles: float
    sumo: Cost
    coupled: Cost
    sumo_wall: Cost
    coupled_wall: Cost
    added: float
    added_wall: float

    def to_dict(self) -> dict[str, Any]:
        """As plain types, for JSON."""
        return asdict(self)


def measure_sumo_speed(
    map_name: str | Path,
    demand: Sequence[Path],
    *,
    source: Literal["sumo-demand", "sumo-traffic"] = "sumo-traffic",
    dt_s: float = 0.1,
    seed: int = 0,
    agents: int = 4,
    after_s: int = 120,
    repeats: int = 5,
    progress: Callable[[str], None] = lambda text: None,
) -> SumoSpeed:
    """Measure by turns.

    Args:
        map_name: an environment's name or folder, or a map file.
        demand: files of routes and additional files, or one `.sumocfg`.
        source: how the world is coupled.
        dt_s: step length of both.
        seed: of both.
        agents: vehicles that the built-in policy drives; a step is a tick.
        after_s: simulated seconds before the first turn.
        repeats: turns of each, of 10 simulated seconds.
        progress: told what is going on.

    Raises:
        ConfigError: a number, a demand, or a demand on this map that cannot work; nobody drives.
        DemandError: SUMO refuses the demand on this map.
        MapError: the map cannot be read or driven.
        MissingExtraError: SUMO is not installed.
    """
    for name, value, most in (("after", after_s, MAX_AFTER_S), ("repeats", repeats, MAX_REPEATS)):
        if not 1 <= value <= most:
            raise ConfigError(f"{name} = {value}: must be from 1 to {most}")
    path = find_map(map_name)
    job = SumoJob(path, read_input(demand), after_s, dt_s, seed)
    warm, ticks = round(after_s / dt_s), round(TURN_S / dt_s)
    settings = {
        "traffic.source": source,
        "traffic.demand": [str(file.resolve()) for file in demand],
        "clock.sim_dt_s": dt_s,
        "clock.ctrl_dt_s": dt_s,
        "population.mode": "seats",
        "horizon_s": float(after_s + (repeats + 1) * TURN_S),
    }
    ours = make_vec(path, num_envs=1, agents=agents, background=0, overrides=settings)
    turns: dict[str, list[_Turn]] = {"ours": [], "sumo": []}
    try:
        ours.reset(seed=seed)
        with tempfile.TemporaryDirectory() as folder, sumo_process(job) as sumo:
            progress(f"SUMO's first {after_s} s")
            sumo.submit(_load, job, folder).result()
            sumo.submit(_turn_of_sumo, warm).result()
            progress(f"the coupled world's first {after_s} s")
            _turn_of_ours(ours, warm)
            for repeat in range(repeats):
                progress(f"measuring, {repeat + 1} of {repeats}")
                turns["sumo"].append(sumo.submit(_turn_of_sumo, ticks).result())
                turns["ours"].append(_turn_of_ours(ours, ticks))
    finally:
        ours.close()
    return _result(turns, path, (source, dt_s, after_s, repeats, agents), ticks)


@dataclass(frozen=True)
class _Turn:
    vehicle_ticks: int
    processor_s: float
    wall_s: float


def _result(
    turns: dict[str, list[_Turn]], path: Path, asked: tuple[str, float, int, int, int], ticks: int
) -> SumoSpeed:
    vehicles = {
        name: sum(turn.vehicle_ticks for turn in own) / (len(own) * ticks)
        for name, own in turns.items()
    }
    if not vehicles["sumo"] > 0.0:
        raise ConfigError("nobody drives: another --after, or more demand")
    costs = {
        (name, clock): _cost([getattr(turn, clock) for turn in own], ticks)
        for name, own in turns.items()
        for clock in ("processor_s", "wall_s")
    }
    added = {
        clock: costs["ours", clock].median / costs["sumo", clock].median - 1.0
        for clock in ("processor_s", "wall_s")
    }
    return SumoSpeed(
        path.name.removesuffix(".gz").removesuffix(".net.xml"),
        *asked,
        sumo_vehicles=vehicles["sumo"],
        our_vehicles=vehicles["ours"],
        sumo=costs["sumo", "processor_s"],
        coupled=costs["ours", "processor_s"],
        sumo_wall=costs["sumo", "wall_s"],
        coupled_wall=costs["ours", "wall_s"],
        added=added["processor_s"],
        added_wall=added["wall_s"],
    )


def _cost(seconds: list[float], ticks: int) -> Cost:
    each = [1e3 * second / ticks for second in seconds]
    return Cost(min(each), median(each), max(each))


def _turn_of_ours(vec: CavVectorEnv, ticks: int) -> _Turn:
    simulation = vec.worlds.simulation
    sumo = simulation.sumo
    pids = () if sumo is None else sumo.worlds.pids
    vehicle_ticks, spent_s, wall_s = 0, -sum(map(processor_s, pids)), 0.0
    for _ in range(ticks):
        actions = vec.suggest_actions()  # what drives the agents is not what is measured
        began, began_s = time.perf_counter(), time.process_time()
        vec.step(actions)
        spent_s += time.process_time() - began_s
        wall_s += time.perf_counter() - began
        vehicle_ticks += len(simulation.vehicles())
    return _Turn(vehicle_ticks, spent_s + sum(map(processor_s, pids)), wall_s)


def _load(job: SumoJob, folder: str) -> None:
    """Load the job into the process that runs SUMO; libsumo keeps it there."""
    start_sumo(job, Path(folder))


def _turn_of_sumo(ticks: int) -> _Turn:
    libsumo = require("libsumo", "sumo")
    vehicle_ticks = 0
    began, began_s = time.perf_counter(), time.process_time()
    for _ in range(ticks):
        libsumo.simulationStep()
        vehicle_ticks += libsumo.vehicle.getIDCount()
    return _Turn(vehicle_ticks, time.process_time() - began_s, time.perf_counter() - began)
