"""Effect of speed advice before signals: stops, standing and speed of agents that follow `glosa`.

Source of the CO₂: `evaluate.signals.emissions`.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from benchmarks.program import run
from cavmarl import load_policy, make_vec
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import OptionalEnvironment, Seed, about
from cavmarl.evaluate.signals.emissions import co2_mg_per_s

STANDING_MPS = 0.1
ADVISED: Mapping[str, Any] = {
    "v2x.enabled": True,
    "v2x.roadside.signals": ["all"],
    "v2x.channel.range_m": 300.0,
    "sensors.messages.signal": True,
    "sensors.messages.timing": True,
    "population.mode": "respawn",
}


class Driving(NamedTuple):
    """What all agents of W worlds did."""

    stops: int
    stood_s: float
    driven_s: float
    distance_m: float
    co2_g: float


def drive(
    policy: str,
    env: str = "grid4x4",
    *,
    agents: int,
    worlds: int = 2,
    seconds: int = 300,
    seed: int = 1,
    overrides: Mapping[str, Any] | None = None,
) -> Driving:
    """Let agents drive without background vehicles; a new trip follows each trip."""
    keys = {**ADVISED, "horizon_s": seconds + 10.0, **(overrides or {})}
    vec = make_vec(env, num_envs=worlds, agents=agents, background=0, overrides=keys)
    with closing(vec):
        driver = load_policy(policy, vec)
        observations, infos = vec.reset(seed=seed)
        stood_before: list[set[int]] = [set() for _ in range(worlds)]
        stops, sums = 0, np.zeros(4)
        for _ in range(round(seconds / vec.step_s)):
            observations, *_, infos = vec.step(driver.act_batch(observations, infos["mask"]))
            for world in range(worlds):
                rows = vec.simulation.vehicles(world)
                rows = rows[rows["agent"] >= 0]
                speed = np.abs(rows["speed"])
                stands = speed < STANDING_MPS
                now = set(rows["id"][stands].tolist())
                stops += len(now - stood_before[world])
                stood_before[world] = now
                co2_mg = co2_mg_per_s(speed, rows["accel"]).sum()
                sums += [stands.sum(), len(rows), speed.sum(), 1e-3 * co2_mg]
        return Driving(stops, *(sums * vec.step_s).tolist())


def measure(
    env: OptionalEnvironment = "grid4x4",
    agents: Annotated[
        list[int] | None, typer.Option("--agents", help="Agents of a world; repeatable.")
    ] = None,
    policy: Annotated[
        list[str] | None, typer.Option("--policy", "-p", help="Policy of the agents; repeatable.")
    ] = None,
    worlds: Annotated[int, about("Worlds, each with other trips.")] = 4,
    seconds: Annotated[int, about("Simulated time.")] = 600,
    seed: Seed = 0,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure stops and speeds of drivers with and without speed advice."""
    check_range(worlds=(worlds, 1, 100), seconds=(seconds, 10, 36_000))
    rows = []
    for count in agents or [6, 20]:
        for name in policy or ["idm", "glosa"]:
            say(f"{count} agents, {name}")
            found = drive(name, env, agents=count, worlds=worlds, seconds=seconds, seed=seed)
            km = max(1e-3 * found.distance_m, 1e-9)
            rows.append(
                {
                    "driver": name,
                    "agents": count,
                    "stops_per_km": found.stops / km,
                    "stood_share": found.stood_s / found.driven_s,
                    "speed_mps": found.distance_m / found.driven_s,
                    "co2_g_per_km": found.co2_g / km,
                }
            )
    return BenchmarkReport(
        f"{env}, {worlds} worlds, {seconds} s",
        {
            "driver": "driver",
            "agents": "agents",
            "stops per km": "stops_per_km:.2f",
            "standing": "stood_share:.1%",
            "speed, m/s": "speed_mps:.2f",
            "CO₂, g/km": "co2_g_per_km:.0f",
        },
        rows,
    )


if __name__ == "__main__":
    run(measure)
