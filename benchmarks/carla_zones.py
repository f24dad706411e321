"""Rates and latencies of hand-overs between zones, which run in servers for CARLA's client.

The benchmark repeats the hand-overs of paper A, Table 4 (`docs/explanation/papers.md`). Each zone
of a world has a process with a server, and a process with CARLA's official client.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Annotated, Any

import numpy as np

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import OptionalEnvironment, about, with_world
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import CavmarlError
from cavmarl.core.processes import dying_with_parent
from cavmarl.cosim.carla.client_process import client_python
from cavmarl.env.vector import make_vec

_WARM_UP = 20
_PORT = re.compile(r":(\d+), for client")


class ServerStartError(CavmarlError):
    """A server for CARLA's client does not start."""


@with_world("seed", "settings")
def measure(
    world: WorldSpec,
    env: OptionalEnvironment = "grid4x4",
    zones: Annotated[str, about("Numbers of zones, comma-separated.")] = "2,4",
    vehicles: Annotated[str, about("Numbers of vehicles, comma-separated.")] = "25,50,100",
    steps: Annotated[int, about("Steps of each row.")] = 300,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure hand-overs between zones with CARLA's client; fail if a vehicle is lost."""
    rows = []
    for count in map(int, zones.split(",")):
        for number in map(int, vehicles.split(",")):
            say(f"{count} zones, {number} vehicles")
            rows.append(measure_zones(world, count, number, steps))
    lost = sum(row["lost"] for row in rows)
    return BenchmarkReport(
        f"{world.env}, {steps} steps, all zones run by servers for CARLA's client",
        {
            "zones": "zones",
            "vehicles": "vehicles",
            "ticks/s": "ticks_per_s:.1f",
            "hand-overs": "hand_overs",
            "median, ms": "median_ms:.1f",
            "99 %, ms": "p99_ms:.1f",
            "lost": "lost",
        },
        rows,
        notes=["latency: from the offer of a vehicle to the confirmation of its new zone"],
        facts={"rows": rows, "lost": lost},
        holds=lost == 0,
    )


def measure_zones(spec: WorldSpec, zones: int, vehicles: int, steps: int) -> dict[str, Any]:
    """Return the rate of a world, and the latencies and losses of its hand-overs.

    Raises:
        MissingExtraError: CARLA's client is not installed.
        ServerStartError: a server does not start.
        ZoneSimulatorError: a zone fails.
    """
    check_range(zones=(zones, 2, 64), vehicles=(vehicles, 2, 1000), steps=(steps, 1, float("inf")))
    client_python()
    agents = 2
    with ExitStack() as stack:
        ports = [stack.enter_context(_server(spec.env, 2 * vehicles)) for _ in range(zones)]
        chosen = replace(spec, agents=agents, background=vehicles - agents)
        vec = make_vec(
            chosen.env,
            zones=zones,
            zone_simulators={z: f"carla://127.0.0.1:{port}" for z, port in enumerate(ports)},
            agents=agents,
            background=vehicles - agents,
            seed=spec.seed,
            overrides={
                "zones.check_invariants": True,
                "zones.max_deferred_ticks": 10,
                "zones.backoff_ticks": 1,
                "population.mode": "respawn",
                **spec.overrides,
            },
        )
        stack.callback(vec.close)
        vec.reset()
        for _ in range(_WARM_UP):
            vec.step(vec.suggest_actions())
        log = vec.simulation.transfers[0]
        log.take()
        before = vec.traffic_stats()
        begin_s = time.perf_counter()
        for _ in range(steps):
            vec.step(vec.suggest_actions())
        wall_s = time.perf_counter() - begin_s
        after = vec.traffic_stats()
        found = log.take()
        entered = after["departed"] - before["departed"]
        left = after["arrived"] - before["arrived"] + after["removed"] - before["removed"]
        ms = np.array([row.ms for row in found if row.ms is not None])
        return {
            "zones": zones,
            "vehicles": vehicles,
            "ticks_per_s": steps * vec.config.clock.ticks_per_step / wall_s,
            "hand_overs": len(found),
            "median_ms": float(np.median(ms)) if ms.size else float("nan"),
            "p99_ms": float(np.quantile(ms, 0.99)) if ms.size else float("nan"),
            "lost": int(before["running"] + entered - left - after["running"]),
        }


@contextmanager
def _server(env: str, places: int) -> Iterator[int]:
    """Run a server of an empty world in a new process; yield the port."""
    words = ["carla", env, "--agents", "1", "--background", "0", "--port", "0"]
    process = subprocess.Popen(
        dying_with_parent(
            [sys.executable, "-m", "cavmarl", *words, "--set", f"population.external={places}"]
        ),
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "COLUMNS": "1000", "PYTHONUNBUFFERED": "1"},
    )
    assert process.stdout is not None
    try:
        lines = []
        for line in process.stdout:
            lines.append(line)
            if match := _PORT.search(line):
                yield int(match[1])
                return
        raise ServerStartError(f"cavmarl {' '.join(words)} has ended: {''.join(lines)[-500:]}")
    finally:
        process.terminate()
        process.wait()
        process.stdout.close()


if __name__ == "__main__":
    run(measure)
