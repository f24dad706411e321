"""The clocks of two of CARLA's clients that share a world: one client ticks, one follows.

The world is cavmarl's, behind its server for CARLA's client; SUMO can move its traffic. As in paper
B (`docs/explanation/papers.md`), three programs are in lock step: SUMO, the world in place of
CARLA, and the clients. In a share of the steps, the second client also ticks, like the paper's
bridge.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np

from benchmarks import carla_clock_client
from benchmarks.carla_clock_client import STEP_S
from benchmarks.clock_drift import ClockDrift, drift_report, rows_of, write_rows
from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import OptionalEnvironment, about, about_file, with_world
from cavmarl.config.world_spec import WorldSpec
from cavmarl.cosim.carla.carla_server import CarlaServer
from cavmarl.cosim.carla.carla_session import OtherTicks
from cavmarl.cosim.carla.client_process import client_python, run_client_program
from cavmarl.cosim.carla.hosted_world import LoadedWorlds
from cavmarl.engine.world_setup import find_map
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import CARS

_HEADWAY_S = 2  # time between departures of SUMO's vehicles


@with_world("agents", "background", "seed", "settings")
def measure(
    world: WorldSpec,
    env: OptionalEnvironment = "grid4x4",
    steps: Annotated[int, about("Ticks of the first client.")] = 5000,
    rogue: Annotated[float, about("Share of steps in which the second client also ticks.")] = 0.0,
    other_ticks: Annotated[
        OtherTicks, about("How the server treats the second client's ticks, as in `cavmarl carla`.")
    ] = "obey",
    sumo: Annotated[int, about("Number of vehicles that SUMO moves.", metavar="N")] = 0,
    csv_path: Annotated[Path | None, about_file("Write the table to this file.", "--csv")] = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Compare the clocks of two of CARLA's clients that share a world (Table II of paper B)."""
    say(f"{steps} steps")
    found = measure_client_drift(
        world, steps=steps, rogue=rogue, other_ticks=other_ticks, sumo=sumo
    )
    if csv_path is not None:
        write_rows(csv_path, found.rows)
    return drift_report(
        found,
        f"{found.environment}, CARLA's client, {1000.0 * found.dt_s:g} ms per step",
        ("first client", "second client"),
        [
            f"the second client ticked {found.own_ticks} times ({found.answer}); the server has "
            f"noticed {found.counted} of these ticks, and the first client {found.drift_events}"
        ],
    )


def measure_client_drift(
    spec: WorldSpec,
    *,
    steps: int,
    rogue: float = 0.0,
    other_ticks: OtherTicks = "obey",
    sumo: int = 0,
) -> ClockDrift:
    """Run a server, and two clients in another process.

    Raises:
        ClientProgramError: the clients fail.
        MissingExtraError: CARLA's client, or an extra, is not installed.
    """
    check_range(steps=(steps, 1, float("inf")), rogue=(rogue, 0.0, 1.0))
    client_python()
    with TemporaryDirectory() as folder:
        if sumo:
            demand = Path(folder) / "trips.rou.xml"
            demand.write_text(trips(spec, sumo), encoding="utf-8")
            coupled = {
                "traffic.source": "sumo-traffic",
                "traffic.demand": [str(demand)],
                "sensors.signal.timing": False,
            }
            spec = replace(spec, overrides={**coupled, **spec.overrides})
        output = Path(folder) / "clocks.json"
        with serving(spec, other_ticks) as server:
            words = (server.port, steps, rogue, int(other_ticks == "follow"), output)
            run_client_program(Path(carla_clock_client.__file__), words)
            counted = server.session.world.master.own_ticks
        read = json.loads(output.read_text(encoding="utf-8"))
    frames = read["frames"]
    jumps = np.flatnonzero(np.diff(frames) > 1)
    first_due = -(-1 // Fraction(str(rogue))) if rogue else 0
    return ClockDrift(
        environment=Path(spec.env).name,
        dt_s=STEP_S,
        rogue=rogue,
        answer=other_ticks,
        pace=None,
        rows=rows_of(list(range(len(frames))), read["second"], STEP_S),
        own_ticks=read["own_ticks"],
        counted=counted,
        drift_events=len(jumps),
        noticed_ticks=int(jumps[0]) + 1 - first_due if len(jumps) else None,
    )


def trips(spec: WorldSpec, number: int) -> str:
    """Return SUMO's demand: cars between random roads of a map."""
    network = load_network(find_map(spec.env))
    for_cars = (network.lanes["permissions"] & CARS) != 0
    moves = network.links[for_cars[network.links["from_lane"]]]
    edges = network.lanes["edge"]
    sources, targets = (np.unique(edges[moves[name]]) for name in ("from_lane", "to_lane"))
    random = np.random.default_rng(spec.seed)
    rows = []
    for n in range(number):
        start, end = (network.edge_ids[random.choice(one)] for one in (sources, targets))
        rows.append(f'<trip id="{n}" depart="{_HEADWAY_S * n}" from="{start}" to="{end}"/>')
    return "<routes>" + "".join(rows) + "</routes>"


@contextmanager
def serving(spec: WorldSpec, other_ticks: OtherTicks) -> Iterator[CarlaServer]:
    over = threading.Event()
    with CarlaServer(LoadedWorlds(spec), port=0, step_s=STEP_S, other_ticks=other_ticks) as server:
        thread = threading.Thread(target=server.run, args=(over.is_set,), daemon=True)
        thread.start()
        try:
            yield server
        finally:  # the thread still steps the world
            over.set()
            thread.join()


if __name__ == "__main__":
    run(measure)
