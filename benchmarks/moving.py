"""Speedup by moving worlds of unequal cost between workers."""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.filling import write_filling_demand
from benchmarks.program import run
from cavmarl.bench.harness import (
    BenchmarkReport,
    Say,
    check_positive,
    paired_ratio,
    silent,
    take_turns,
)
from cavmarl.cli.output import OptionalEnvironment, Seed, Settings, about, parse_settings
from cavmarl.core.errors import ConfigError, EvaluationError
from cavmarl.engine.world_setup import load_world
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.parallel.workers.pooled_worlds import PooledWorlds
from cavmarl.zones.partition.zone_statistics import imbalance

SETTLE_ROUNDS = 6  # rounds of moves before the first measurement


def measure(
    env: OptionalEnvironment = "grid4x4",
    worlds: Annotated[int, about("Number of parallel worlds.")] = 16,
    workers: Annotated[int, about("Number of workers.")] = 2,
    lead: Annotated[int, about("Steps before half of the worlds restart.")] = 600,
    every: Annotated[int, about("Steps between two rounds of moves.")] = 10,
    period: Annotated[float, about("Seconds between vehicles on each road into the map.")] = 5.0,
    steps: Annotated[int, about("Steps per turn.")] = 20,
    repeats: Annotated[int, about("Turns of each side.")] = 7,
    seed: Seed = 0,
    settings: Settings = None,
    at_least: Annotated[
        float | None, about("Exit with 1 if moving is not at least this many times faster.")
    ] = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Compare worlds of unequal cost that stay on their workers with worlds that move.

    The worlds fill with vehicles, and half of the worlds restart. Then both sides step in turn.
    Each worker begins with the same number of worlds, so the first half of the workers has the full
    worlds.
    """
    check_positive("--at-least", at_least)
    if not 2 <= workers <= worlds or min(lead, every, steps, repeats) < 1 or not period > 0.0:
        raise ConfigError(
            f"{worlds} worlds over {workers} workers, {lead} steps before, a round every {every}, "
            f"{repeats} turns of {steps} steps, {period:g} s: must be at least 2 workers, at most "
            "one per world, and all other numbers above 0"
        )
    overrides = parse_settings(settings)
    measured: dict[str, _Measured] = {}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "filling.rou.xml"
        world = load_world(env, overrides=overrides)
        all_steps = (
            lead + SETTLE_ROUNDS * every + repeats * steps + 1
        )  # the horizon, so that no episode ends
        seconds = all_steps * world.config.clock.ctrl_dt_s
        write_filling_demand(world.network, path, seconds=seconds, period_s=period)
        wanted = {
            "traffic.demand": [str(path)],
            "traffic.on_bad_route": "skip",
            "population.mode": "respawn",
            "horizon_s": seconds,
            **overrides,
        }
        try:
            for name, balance_steps in (("fixed", 0), ("moving", every)):
                say(f"{name}: {lead} steps")
                vec = make_vec(
                    env,
                    num_envs=worlds,
                    workers=workers,
                    agents=1,
                    background=0,
                    overrides={**wanted, "workers.balance_steps": balance_steps},
                )
                measured[name] = _Measured(vec)
                measured[name].lead(seed, lead, SETTLE_ROUNDS * every)
            sides = {name: one.turner(steps) for name, one in measured.items()}
            turns = take_turns(sides, repeats, say)
            fixed, moved = (one.state() for one in measured.values())
        finally:
            for one in measured.values():
                one.vec.close()
    if fixed != moved:
        raise EvaluationError(f"{env}: the states of moving and fixed worlds differ")
    rows = [one.row(name, turns[name], repeats * steps) for name, one in measured.items()]
    return _report(env, rows, workers, fixed[1], at_least)


def _report(
    env: str,
    rows: list[dict[str, Any]],
    workers: int,
    vehicles: tuple[int, ...],
    at_least: float | None,
) -> BenchmarkReport:
    fixed, moving = rows
    half = len(vehicles) // 2
    ratio = paired_ratio(fixed["step_ms"], moving["step_ms"])
    processor_ratio = fixed["busiest_ms"] / moving["busiest_ms"]
    return BenchmarkReport(
        f"{env}: {len(vehicles)} worlds over {workers} workers; {half} with "
        f"{statistics.fmean(vehicles[:half]):.0f} vehicles, {len(vehicles) - half} with "
        f"{statistics.fmean(vehicles[half:]):.0f}",
        {
            "worlds": "name",
            "step, ms: min": "least_ms:.2f",
            "median": "median_ms:.2f",
            "busiest, ms": "busiest_ms:.2f",
            "max / mean": "imbalance:.2f",
            "moves": "moves",
            "ms per move": "move_ms:.1f",
        },
        rows,
        notes=[
            f"speedup by moving: {ratio:.2f}; by the busiest worker's processor time: "
            f"{processor_ratio:.2f}; both sides have the same states"
        ],
        facts={
            "ratio": ratio,
            "processor_ratio": processor_ratio,
            "workers": workers,
            "vehicles": vehicles,
        },
        holds=at_least is None or ratio >= at_least,
    )


class _Measured:
    """Worlds on workers, and the times of their turns."""

    def __init__(self, vec: CavVectorEnv) -> None:
        assert isinstance(vec.worlds, PooledWorlds)
        self.vec = vec
        self._worlds = vec.worlds
        self._busy_s = np.zeros(len(vec.worlds.pool.pids))

    def lead(self, seed: int, steps: int, settle: int) -> None:
        """Fill the worlds, restart the second half, and let movable worlds move."""
        vec = self.vec
        vec.reset(seed=seed)
        self._drive(steps)
        vec.reset(options={"reset_mask": np.arange(vec.num_envs) >= vec.num_envs // 2})
        self._drive(settle)

    def turner(self, steps: int) -> Any:
        """Return a function that runs a turn and returns ms per step."""

        def turn() -> float:
            before = self._processor_s()
            spent_s = self._drive(steps)
            self._busy_s += self._processor_s() - before
            return 1e3 * spent_s / steps

        return turn

    def state(self) -> tuple[list[str], tuple[int, ...]]:
        """Return the hashes of all worlds, and their numbers of vehicles."""
        vec, worlds = self.vec, range(self.vec.num_envs)
        vehicles = tuple(int(vec.traffic_stats(w)["running"]) for w in worlds)
        return [vec.state_hash(w) for w in worlds], vehicles

    def row(self, name: str, step_ms: tuple[float, ...], steps: int) -> dict[str, Any]:
        """Return the results of a number of steps."""
        mover = self._worlds.mover
        moves = 0 if mover is None else mover.moves
        return {
            "name": name,
            "step_ms": step_ms,
            "least_ms": min(step_ms),
            "median_ms": statistics.median(step_ms),
            "busiest_ms": 1e3 * float(self._busy_s.max()) / steps,
            "imbalance": imbalance(self._busy_s.tolist()),
            "moves": moves,
            "move_ms": 1e3 * mover.moved_s / moves if mover is not None and moves else None,
        }

    def _drive(self, steps: int) -> float:
        """Return the time of the steps in s; agents coast."""
        actions = np.zeros_like(self.vec.action_space.sample())
        began = time.perf_counter()
        for _ in range(steps):
            self.vec.step(actions)
        return time.perf_counter() - began

    def _processor_s(self) -> NDArray[np.float64]:
        return np.array(self._worlds.pool.processor_s())


if __name__ == "__main__":
    run(measure)
