"""Cost of SUMO as global traffic: libsumo alone, compared with a world coupled to SUMO.

Both simulations run the same demand with the same step length and seed up to the same second. Then
they take turns of equal simulated length. The time of the coupled world includes both of its
processes and their communication.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from enum import StrEnum
from functools import partial
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import typer

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent, take_turns
from cavmarl.bench.traffic_speed import TURN_S, Turn, load_sumo, turn_of_sumo
from cavmarl.cli.output import Seed, about
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import find_map
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.evaluate.traffic.sumo_side import SumoJob, sumo_process
from cavmarl.parallel.processes.watchdog import processor_s
from cavmarl.traffic.sumo.sumo_input import read_input


class Source(StrEnum):
    """The kind of coupling to SUMO."""

    DEMAND = "sumo-demand"
    TRAFFIC = "sumo-traffic"


def measure(
    map_name: Annotated[str, typer.Argument(metavar="MAP", help="A map file or an environment.")],
    demand: Annotated[
        list[Path], about("A .rou.xml, .add.xml or .sumocfg; may be repeated.", "--demand", "-d")
    ],
    source: Annotated[Source, about("Kind of coupling.")] = Source.TRAFFIC,
    dt: Annotated[float, about("Step length of both simulations, in seconds.")] = 0.1,
    agents: Annotated[int, about("Number of agents.", min=1)] = 4,
    seed: Seed = 0,
    after: Annotated[int, about("Simulated seconds before the first turn.")] = 120,
    repeats: Annotated[int, about("Turns per side, of 10 simulated seconds.")] = 5,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure the time that coupling a world to SUMO adds to the time of libsumo alone."""
    check_range(after=(after, 1, 3600), repeats=(repeats, 1, 100))
    path = find_map(map_name)
    job = SumoJob(path, read_input(demand), after, dt, seed)
    warm, ticks = round(after / dt), round(TURN_S / dt)
    settings = {
        "traffic.source": source.value,
        "traffic.demand": [str(file.resolve()) for file in demand],
        "clock.sim_dt_s": dt,
        "clock.ctrl_dt_s": dt,
        "population.mode": "respawn",
        "horizon_s": float(after + (repeats + 1) * TURN_S),
    }
    ours = make_vec(path, num_envs=1, agents=agents, background=0, overrides=settings)
    try:
        ours.reset(seed=seed)
        with tempfile.TemporaryDirectory() as folder, sumo_process(job) as sumo:
            say(f"SUMO's first {after} s")
            sumo.submit(load_sumo, job, folder).result()
            sumo.submit(turn_of_sumo, warm).result()
            say(f"the coupled world's first {after} s")
            _turn_of_ours(ours, warm)
            sides: dict[str, Callable[[], Turn]] = {
                "libsumo alone": lambda: sumo.submit(turn_of_sumo, ticks).result(),
                "coupled world": partial(_turn_of_ours, ours, ticks),
            }
            turns = take_turns(sides, repeats, say)
    finally:
        ours.close()
    alone, coupled = rows = [_row(name, own, ticks) for name, own in turns.items()]
    if not alone["vehicles"] > 0.0:
        raise ConfigError("no vehicle drives: change --after, or add demand")
    added, added_wall = (coupled[key] / alone[key] - 1.0 for key in ("median_ms", "median_wall_ms"))
    return BenchmarkReport(
        f"{path.name.removesuffix('.gz').removesuffix('.net.xml')}, {source.value}, step {dt:g} s, "
        f"{agents} agents, {repeats} turns of each, after {after} s",
        {
            "ms per tick": "name",
            "vehicles": "vehicles:,.0f",
            "min": "low_ms:.2f",
            "median": "median_ms:.2f",
            "max": "high_ms:.2f",
            "median, wall clock": "median_wall_ms:.2f",
        },
        rows,
        notes=[
            f"coupling adds {added:.2f} times the time of libsumo alone ({added_wall:.2f} by "
            "wall time)"
        ],
        facts={"added": added, "added_wall": added_wall, "agents": agents, "dt_s": dt},
    )


def _row(name: str, turns: tuple[Turn, ...], ticks: int) -> dict[str, Any]:
    spent_ms = [1e3 * turn.cpu_s / ticks for turn in turns]
    return {
        "name": name,
        "vehicles": sum(turn.vehicle_steps for turn in turns) / (len(turns) * ticks),
        "low_ms": min(spent_ms),
        "median_ms": median(spent_ms),
        "high_ms": max(spent_ms),
        "median_wall_ms": median(1e3 * turn.wall_s / ticks for turn in turns),
    }


def _turn_of_ours(vec: CavVectorEnv, ticks: int) -> Turn:
    simulation = vec.worlds.simulation
    sumo = simulation.sumo
    pids = () if sumo is None else sumo.worlds.pids
    vehicle_ticks, spent_s, wall_s = 0, -sum(map(processor_s, pids)), 0.0
    for _ in range(ticks):
        actions = vec.suggest_actions()  # not timed
        began, began_s = time.perf_counter(), time.process_time()
        vec.step(actions)
        spent_s += time.process_time() - began_s
        wall_s += time.perf_counter() - began
        vehicle_ticks += len(simulation.vehicles())
    return Turn(vehicle_ticks, spent_s + sum(map(processor_s, pids)), wall_s)


if __name__ == "__main__":
    run(measure)
