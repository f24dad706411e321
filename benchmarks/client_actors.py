"""Actors that a client in another thread brings: delay until they appear, and their cost."""

from __future__ import annotations

import tempfile
import threading
import time
from contextlib import closing
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import numpy as np

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import OptionalEnvironment, about, with_world
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.records.codes import DRIVER_EXTERNAL
from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.cosim.followers.follower_client import Follower
from cavmarl.cosim.followers.follower_messages import ActorRequest, PoseView
from cavmarl.env.parallel import CavEnv, parallel_env

STEP_S = 0.05
SPACING_M = 15.0  # distance between actors
ASIDE_M = 90.0  # distance from the map, so that no vehicle sees the actors


@with_world("agents", "background", "seed", "settings")
def measure(
    world: WorldSpec,
    env: OptionalEnvironment = "grid4x4",
    visits: Annotated[int, about("Number of clients that join and leave.")] = 20,
    actors: Annotated[int, about("Actors of each client.")] = 4,
    rate_hz: Annotated[float, about("Rate of the poses of each actor.")] = 100.0,
    steps: Annotated[int, about("Steps of each visit, and of each pause.")] = 20,
    say: Say = silent,
) -> BenchmarkReport:
    """Compare a world to which clients bring actors with the same world without clients."""
    check_range(
        visits=(visits, 1, 10_000), actors=(actors, 1, 50), rate_hz=(rate_hz, 1.0, 1000.0),
        steps=(steps, 2, 10_000),
    )  # fmt: skip
    runs = []
    for name, count in (("without clients", 0), ("with clients", actors)):
        say(name)
        runs.append(_Run(world, visits, count, rate_hz, steps).measured(name))
    without, beside = runs
    is_equal = without.pop("others") == beside.pop("others")
    at_once = beside["most_steps"] == 1
    return BenchmarkReport(
        title=f"{world.env or env}: {visits} visits of {actors} actors at {rate_hz:g} Hz",
        columns={
            "": "name",
            "ms per step": "step_ms:.2f",
            "steps until present": "most_steps",
            "ms until present, median": "there_ms:.1f",
            "poses": "poses",
            "late": "late",
            "lost": "lost",
        },
        rows=runs,
        notes=[
            "the other vehicles are "
            + ("equal, bit for bit, in all steps" if is_equal else "[bold]not equal[/]")
        ],
        facts={"others_equal": is_equal},
        holds=is_equal and at_once,
        caption="present: all actors are in the world; steps until present: maximum of all visits",
    )


class _Run:
    """A world in which clients join and leave."""

    def __init__(
        self, spec: WorldSpec, visits: int, actors: int, rate_hz: float, steps: int
    ) -> None:
        self._visits, self._actors, self._rate_hz, self._steps = visits, actors, rate_hz, steps
        horizon_s = STEP_S * (2 * visits * steps + 10)
        overrides = {
            "population.mode": "respawn",
            "clock.ctrl_dt_s": STEP_S,
            "horizon_s": horizon_s,
            "population.external": 50,
            **spec.overrides,
        }
        self._env: CavEnv = parallel_env(spec.env, **{**spec.keywords, "overrides": overrides})
        self._seed = spec.seed
        self._step_s: list[float] = []
        self._others: list[bytes] = []

    def measured(self, name: str) -> dict[str, Any]:
        """Return the measurements of the run."""
        there_s, steps_until = [], []
        with (
            tempfile.TemporaryDirectory() as folder,
            closing(self._env),
            FollowedWorld(self._env, Path(folder) / "s") as world,
        ):
            world.reset(self._seed)
            for _ in range(self._visits):
                self._run_on(world, self._steps)
                began = time.perf_counter()
                client = self._join(world) if self._actors else None
                if client is None:
                    self._run_on(world, self._steps)
                    continue
                with client:
                    count = 0
                    while len(self._env.external.vehicles()) < self._actors:
                        self._send(client, world)
                        self._run_on(world, 1)
                        count += 1
                    there_s.append(time.perf_counter() - began)
                    steps_until.append(count)
                    for _ in range(self._steps - count):
                        self._send(client, world)
                        self._run_on(world, 1)
            self._run_on(world, 2)
            report = world.actors.report()
        return {
            "name": name,
            "step_ms": 1e3 * median(self._step_s),
            "most_steps": max(steps_until, default=0),
            "there_ms": 1e3 * median(there_s) if there_s else 0.0,
            "poses": sum(row["received"] for row in report),
            "late": sum(row["late"] for row in report),
            "lost": sum(row["lost"] for row in report),
            "others": self._others,
        }

    def _places(self) -> list[tuple[float, float]]:
        min_x, min_y, _, _ = self._env.network.extent_m
        return [(min_x + SPACING_M * k, min_y - ASIDE_M) for k in range(self._actors)]

    def _join(self, world: FollowedWorld) -> Follower:
        orders = [
            ActorRequest(f"a{k}", "car", x, y, 0.0, rate_hz=self._rate_hz)
            for k, (x, y) in enumerate(self._places())
        ]
        found: list[Follower] = []
        caller = threading.Thread(
            target=lambda: found.append(Follower(world.address, actors=orders, waits=False))
        )
        caller.start()
        while not world.seats:
            world.admit(1.0)
        caller.join()
        return found[0]

    def _send(self, client: Follower, world: FollowedWorld) -> None:
        """Send the poses of the next step."""
        now_s = int(world.master.world_ticks[0]) * self._env.config.clock.sim_dt_s
        first, last = (int(round(at_s * self._rate_hz, 6)) for at_s in (now_s, now_s + STEP_S))
        client.send_poses(
            {
                f"a{k}": [
                    PoseView(n / self._rate_hz, x + 0.1 * n / self._rate_hz, y, 0.0)
                    for n in range(first + 1, last + 1)
                ]
                for k, (x, y) in enumerate(self._places())
            }
        )

    def _run_on(self, world: FollowedWorld, steps: int) -> None:
        for _ in range(steps):
            began = time.perf_counter()
            world.step()
            self._step_s.append(time.perf_counter() - began)
            rows = self._env.simulation.vehicles(0)
            rows = rows[rows["driver"] != DRIVER_EXTERNAL]
            self._others.append(rows[np.argsort(rows["id"])].tobytes())


if __name__ == "__main__":
    run(measure)
