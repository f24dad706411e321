"""Worlds without workers, with one and with several, and the limit of the machine."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any

from benchmarks.program import run
from benchmarks.worker_speed import measure_ceiling, measure_workers
from cavmarl.bench.harness import BenchmarkReport, Say, is_kept, silent, spread
from cavmarl.cli.output import AtLeast, OptionalEnvironment, about, with_world
from cavmarl.config.world_spec import WorldSpec


@with_world()
def measure(
    world: WorldSpec,
    env: OptionalEnvironment = "rush",
    worlds: Annotated[int, about("Number of parallel worlds.")] = 16,
    count: Annotated[int, about("Number of workers to compare with one worker.", "--workers")] = 2,
    steps: Annotated[int, about("Steps per turn.")] = 20,
    repeats: Annotated[int, about("Turns per number of workers.")] = 7,
    at_least: AtLeast = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure steps without workers, with one and with several workers, and an empty command."""
    turns: dict[str, Any] = {"worlds": worlds, "steps": steps, "repeats": repeats}
    found = measure_workers(world, workers=count, say=say, **turns)
    say("stepping worlds in independent programs")
    ceiling = measure_ceiling(world, programs=count, **turns)
    low, middle, high, highest = found.barrier_us
    notes = [
        f"speedup of {count} workers over one: [bold]{found.ratio:.2f}[/], by the busiest one's "
        f"processor time {found.processor_ratio:.2f}; a step with one worker takes "
        f"{found.cost_of_one:.2f} times as long as without workers",
        f"an empty command to all {count}: [bold]{middle:.1f}[/] µs "
        f"({low:.1f} / {high:.1f} / {highest:.1f}: 5, 95, 99 %); idle workers take "
        f"{found.idle_s:.1%} of a core",
        f"{count} independent programs, side by side: [bold]{ceiling.ratio:.2f}[/] times "
        "as fast as one after the other; this is the machine's limit",
    ]
    if found.is_crowded:
        notes.append("[yellow]note: more workers than cores[/]")
    return BenchmarkReport(
        f"{found.env}: {found.worlds} worlds, turns of {found.steps} steps",
        {
            "workers": "workers",
            "created in, s": "made_s:.2f",
            "step, ms: min": "low_ms:.2f",
            "median": "median_ms:.2f",
            "max": "high_ms:.2f",
            "busiest, ms": "busiest_ms:.2f",
        },
        [
            {
                **asdict(row),
                "low_ms": min(row.step_ms),
                "median_ms": spread(row.step_ms).median,
                "high_ms": max(row.step_ms),
            }
            for row in found.rows
        ],
        notes=notes,
        facts={
            **asdict(found),
            "ratio": found.ratio,
            "processor_ratio": found.processor_ratio,
            "cost_of_one": found.cost_of_one,
            "is_crowded": found.is_crowded,
            "ceiling": ceiling.facts(),
        },
        holds=is_kept(at_least, found.ratio),
    )


if __name__ == "__main__":
    run(measure)
