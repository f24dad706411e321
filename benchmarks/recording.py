"""Cost of recording, measured with the same worlds with and without a recording, in turn."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter, thread_time
from typing import Annotated

from benchmarks.program import run
from cavmarl.bench.harness import (
    BenchmarkReport,
    Say,
    check_positive,
    paired_ratio,
    silent,
    take_turns,
)
from cavmarl.cli.output import OptionalEnvironment, Seed, about
from cavmarl.core.errors import ConfigError
from cavmarl.env.vector import CavVectorEnv, make_vec


def measure(
    env: OptionalEnvironment = "town",
    vehicles: Annotated[int, about("Number of vehicles; one in ten is an agent.")] = 1000,
    steps: Annotated[
        int, about("Steps per turn; 400 steps write several parts of a recording.")
    ] = 400,
    turns: Annotated[int, about("Turns of each side.")] = 7,
    seed: Seed = 0,
    at_most: Annotated[
        float | None,
        about("Exit with 1 if a recorded step takes more than this many times as long."),
    ] = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure ms per step of the same episodes with and without a recording.

    Both wall time and processor time of the stepping thread are shown. Other programs do not affect
    the processor time.
    """
    check_positive("--at-most", at_most)
    if not (vehicles >= 10 and steps >= 1 and turns >= 1):
        raise ConfigError(
            f"vehicles = {vehicles}, steps = {steps}, turns = {turns}: must be at least 10, 1, 1"
        )
    agents = vehicles // 10

    def made(record: Path | None) -> CavVectorEnv:
        background = vehicles - agents
        return make_vec(env, seed=seed, agents=agents, background=background, record=record)

    with TemporaryDirectory() as room:
        say("creating the worlds")
        path = Path(room) / "recording"
        sides = {"not recorded": made(None), "recorded": made(path)}
        for vec in sides.values():
            vec.reset()
            _steps_s(vec, steps, [])
        own: dict[str, list[float]] = {name: [] for name in sides}
        timed = {name: partial(_steps_s, vec, steps, own[name]) for name, vec in sides.items()}
        found = take_turns(timed, turns, say)
        for vec in sides.values():
            vec.close()
        size = sum(file.stat().st_size for file in path.rglob("*.parquet"))
    ratio = paired_ratio(found["recorded"], found["not recorded"])
    frames = steps * (turns + 1) + 1
    rows = [
        {
            "side": name,
            "ms": 1e3 * median(taken) / steps,
            "least": 1e3 * min(taken) / steps,
            "own": 1e3 * median(own[name]) / steps,
        }
        for name, taken in found.items()
    ]
    own_ratio = paired_ratio(own["recorded"], own["not recorded"])
    return BenchmarkReport(
        f"A step of {env}, {vehicles} vehicles",
        {"": "side", "ms per step": "ms:.3f", "lowest": "least:.3f", "processor": "own:.3f"},
        rows,
        [
            f"recorded: {ratio:.3f} times as long, {own_ratio:.3f} times the processor time of "
            f"the thread that steps, {size / frames / 1e3:.1f} kB per frame"
        ],
        {"ratio": ratio, "own_ratio": own_ratio, "bytes_per_frame": size / frames},
        holds=at_most is None or ratio <= at_most,
    )


def _steps_s(vec: CavVectorEnv, steps: int, own: list[float]) -> float:
    """Return the time of steps in s; decisions of the built-in drivers are not timed.

    Append the processor time of this thread in s to `own`.
    """
    took = spent = 0.0
    for _ in range(steps):
        actions = vec.suggest_actions()
        began, had = perf_counter(), thread_time()
        vec.step(actions)
        took += perf_counter() - began
        spent += thread_time() - had
    own.append(spent)
    return took


if __name__ == "__main__":
    run(measure)
