"""Closed roads compared with SUMO's rerouters, with the same demand, closures and seeds."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import defusedxml.ElementTree
import numpy as np

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, numbers_of, silent
from cavmarl.cli.output import about
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import World, find_map
from cavmarl.evaluate.traffic.native_side import idle_commands, load_demand
from cavmarl.evaluate.traffic.sumo_side import SumoJob, start_sumo, sumo_process
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.shards.shard import Commands
from cavmarl.traffic.sumo.sumo_input import read_input

ROADS = "B1B2,B2B1,B1C1,C1B1"
TICK_S = 0.1


def measure(
    map_name: Annotated[str, about("Map or environment.")] = "grid4x4",
    roads: Annotated[str, about("Comma-separated ids of the closed roads.")] = ROADS,
    vehicles: Annotated[int, about("Vehicles of the demand.")] = 300,
    seconds: Annotated[int, about("Simulated seconds per run.")] = 900,
    close_s: Annotated[int, about("Second in which the roads close.")] = 60,
    seeds: Annotated[str, about("Comma-separated seeds of cavmarl and SUMO.")] = "1,2,3",
    say: Say = silent,
) -> BenchmarkReport:
    """Compare arrivals and travel times with open and with closed roads."""
    check_range(seconds=(seconds, 1, 100_000), close_s=(close_s, 0, seconds))
    rows = []
    for seed in numbers_of("--seeds", seeds):
        for closed in ((), tuple(roads.split(","))):
            say(f"seed {seed}, {len(closed)} closed roads")
            rows.append(compare(map_name, closed, vehicles, seconds, close_s, seed))
    columns = {
        "seed": "seed",
        "closed roads": "closed",
        "arrived": "arrived",
        "SUMO": "sumo_arrived",
        "mean trip, s": "trip_s:.1f",
        "SUMO, s": "sumo_trip_s:.1f",
        "re-routed": "rerouted",
        "waiting": "waiting",
        "running": "running",
    }
    return BenchmarkReport(
        f"{map_name}, {vehicles} vehicles, {seconds} s, roads close after {close_s} s",
        columns,
        rows,
    )


def compare(
    map_name: str, closed: Sequence[str], vehicles: int, seconds: int, close_s: int, seed: int
) -> dict[str, Any]:
    """Run cavmarl and SUMO; return arrivals and mean travel times of each."""
    map_file = find_map(map_name)
    network = load_network(map_file)
    with tempfile.TemporaryDirectory() as name:
        demand = Path(name) / "trips.rou.xml"
        demand.write_text(trips(network, vehicles, seconds // 2, seed), encoding="utf-8")
        ours = run_native(map_file, demand, closed, seconds, close_s, seed)
        rules = Path(name) / "closures.add.xml"
        rules.write_text(rerouter(roads_of(network), closed, close_s), encoding="utf-8")
        job = SumoJob(map_file, read_input([demand, rules]), seconds, TICK_S, seed, teleports=False)
        with sumo_process(job) as process:
            times = process.submit(sumo_trip_times, job).result()
    return {
        "seed": seed,
        "closed": len(closed),
        **ours,
        "sumo_arrived": len(times),
        "sumo_trip_s": float(np.mean(times)) if times else 0.0,
    }


def roads_of(network: RoadNetwork) -> list[str]:
    """Return the ids of all roads."""
    rows = np.flatnonzero(~network.edges["internal"]).tolist()
    return [network.edge_ids[row] for row in rows]


def trips(network: RoadNetwork, vehicles: int, within_s: float, seed: int) -> str:
    """Return a file of trips between random roads that are not in `ROADS`."""
    random = np.random.default_rng(seed)
    starts, goals = (
        {network.edge_ids[edge] for edge in network.lanes["edge"][network.links[side]].tolist()}
        for side in ("from_lane", "to_lane")
    )
    ends = [road for road in roads_of(network) if road not in ROADS.split(",")]
    lines: list[str] = []
    while len(lines) < vehicles:
        first, last = (ends[k] for k in random.choice(len(ends), 2, replace=False).tolist())
        if first in starts and last in goals:
            lines.append(
                f'<trip id="{len(lines)}" type="car" from="{first}" to="{last}" '
                f'depart="{within_s * len(lines) / vehicles:.2f}" departLane="best" '
                'departSpeed="0"/>'
            )
    return '<routes><vType id="car" vClass="passenger"/>' + "\n".join(lines) + "</routes>"


def sumo_trip_times(job: SumoJob) -> list[float]:
    """Run the job in SUMO; return the travel times in s of the vehicles that arrived."""
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / "trips.xml"
        libsumo = start_sumo(job, Path(name), f"--tripinfo-output={out}")
        for _ in range(round(job.seconds / job.dt_s)):
            libsumo.simulationStep()
        libsumo.close()
        found = defusedxml.ElementTree.parse(out).iter("tripinfo")
        return [float(trip.attrib["duration"]) for trip in found]


def rerouter(edges: Sequence[str], closed: Sequence[str], close_s: int) -> str:
    """Return SUMO's file of a rerouter on all edges, which closes roads from a time on."""
    closings = "".join(f'<closingReroute id="{edge}"/>' for edge in closed)
    interval = f'<interval begin="{close_s}" end="1000000">{closings}</interval>'
    rule = f'<rerouter id="closures" edges="{" ".join(edges)}">{interval}</rerouter>'
    return f"<additional>{rule if closed else ''}</additional>"


def run_native(
    map_file: Path, demand: Path, closed: Sequence[str], seconds: int, close_s: int, seed: int
) -> dict[str, Any]:
    """Run the demand in cavmarl, and close the roads."""
    network = load_network(map_file)
    lanes = np.flatnonzero(
        np.isin(network.lanes["edge"], [network.edge_ids.index(edge) for edge in closed])
    )
    own = {"map.changed_lanes": len(lanes)}
    world: World = load_demand(map_file, [demand], seconds, TICK_S, own)
    config, network, file, partition = world
    simulation = Simulation(config, network, demand=file, partition=partition)
    simulation.seed(seed)
    simulation.reset()
    idle = idle_commands(simulation)
    changes = np.zeros((1, len(lanes), 3))
    changes[0, :, 0] = lanes + 1
    changes[0, :, 1] = network.lanes["speed_mps"][lanes]
    changes[0, :, 2] = 511
    closing = Commands(idle.controls, idle.meta_actions, lane_changes=changes)
    first = round(close_s / TICK_S)
    for tick in range(round(seconds / TICK_S)):
        simulation.step(closing if tick >= first else idle)
    stats = simulation.traffic_stats()
    return {
        "arrived": stats.arrived,
        "trip_s": stats.mean_trip_s,
        "rerouted": stats.rerouted,
        "waiting": stats.waiting,
        "running": stats.running,
    }


if __name__ == "__main__":
    run(measure)
