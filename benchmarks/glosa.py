"""Effect of speed advice before signals: stops, standing and speed of agents that follow `glosa`.

`glosa`: green light optimal speed advisory, a driver of the library. Source of the CO₂:
`driving.kernels.emissions`.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.program import run
from cavmarl import load_policy, make_vec
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import OptionalEnvironment, Seed, about
from cavmarl.driving.vehicle_emissions import emissions_of
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.signals.controllers import SignalController

STANDING_MPS = 0.1
ADVISED: dict[str, Any] = {
    "v2x.enabled": True,
    "v2x.roadside.signals": ["all"],
    "v2x.channel.range_m": 300.0,
    "sensors.messages.signal": True,
    "sensors.messages.timing": True,
    "population.mode": "respawn",
}


class Driving(NamedTuple):
    """Sums over all agents of one or several worlds."""

    stops: float
    stood_s: float
    driven_s: float
    delay_s: float  # driving time minus the time at the desired speed
    distance_m: float
    co2_g: float


def drive(policy: str, env: str = "grid4x4", **arguments: Any) -> Driving:
    """Return the results of `drive_worlds`, summed over its worlds."""
    found = np.sum(drive_worlds(policy, env, **arguments), axis=0)
    return Driving(*found.tolist())


def drive_worlds(
    policy: str,
    env: str = "grid4x4",
    *,
    agents: int,
    worlds: int = 2,
    seconds: int = 300,
    seed: int = 1,
    controller: SignalController | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> list[Driving]:
    """Let agents drive without background vehicles; a new trip follows each trip.

    With `signals.agents`, a controller chooses greens. Return the sums of each world.
    """
    keys = {**ADVISED, "horizon_s": seconds + 10.0, **(overrides or {})}
    vec = make_vec(env, num_envs=worlds, agents=agents, background=0, overrides=keys)
    with closing(vec):
        driver = load_policy(policy, vec, beside_signals=controller is not None)
        observations, infos = vec.reset(seed=seed)
        meters = [_Meter(vec.step_s) for _ in range(worlds)]
        for _ in range(round(seconds / vec.step_s)):
            if controller is None:
                actions: Any = driver.act_batch(observations, infos["mask"])
            else:
                actions = {
                    "vehicles": driver.act_batch(observations["vehicles"], infos["mask"]),
                    "signals": np.maximum(controller.choose(vec.signals.view), 0),
                }
            observations, *_, infos = vec.step(actions)
            for world, meter in enumerate(meters):
                rows = vec.simulation.vehicles(world)
                meter.sample(rows[rows["agent"] >= 0])
        return [Driving(*meter.sums.tolist()) for meter in meters]


class _Meter:
    """Adds up the values of `Driving` for the agents of a world."""

    def __init__(self, step_s: float) -> None:
        self._step_s = step_s
        self._last = np.zeros(0, VEHICLE)
        self.sums = np.zeros(len(Driving._fields))

    def sample(self, rows: NDArray[np.void]) -> None:
        """Add a step, with the vehicles (n,) at its end."""
        rows = rows[np.argsort(rows["id"])]
        speed, step_s = np.abs(rows["speed"]), self._step_s
        stands = speed < STANDING_MPS
        _, now, before = np.intersect1d(rows["id"], self._last["id"], return_indices=True)
        stood = np.zeros(len(rows), dtype=np.bool_)
        stood[now] = np.abs(self._last["speed"][before]) < STANDING_MPS
        free_s = rows["free_s"].sum() - self._last["free_s"][before].sum()
        co2_g = emissions_of(rows, np.zeros(len(rows), np.int64), step_s)[:, 1].sum()
        self.sums += [
            (stands & ~stood).sum(),
            stands.sum() * step_s,
            len(rows) * step_s,
            len(rows) * step_s - free_s,
            speed.sum() * step_s,
            co2_g,
        ]
        self._last = rows.copy()


def measure(
    env: OptionalEnvironment = "grid4x4",
    agents: Annotated[
        list[int] | None, typer.Option("--agents", help="Agents of a world; repeatable.")
    ] = None,
    policy: Annotated[
        list[str] | None, typer.Option("--policy", "-p", help="Policy of the agents; repeatable.")
    ] = None,
    worlds: Annotated[int, about("Number of worlds; each has different trips.")] = 4,
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
