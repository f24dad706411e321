"""The clocks of a time master and of a follower in another process, after the same steps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from benchmarks.clock_drift import ClockDrift, drift_report, measure_drift, write_rows
from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, silent
from cavmarl.cli.output import OptionalEnvironment, about, about_file, with_world
from cavmarl.config.world_spec import WorldSpec


@with_world("seed", "settings")
def measure(
    world: WorldSpec,
    env: OptionalEnvironment = "ring",
    steps: Annotated[int, about("Steps of the master; a step is one tick.")] = 5000,
    rogue: Annotated[
        float, about("Share of steps in which the follower also ticks on its own.")
    ] = 0.0,
    own_ticks: Annotated[
        Literal["obey", "refuse", "ignore"],
        about("How the master treats the follower's ticks; obey: the world ticks."),
    ] = "obey",
    pace: Annotated[
        float | None,
        about("Simulated seconds per second; also compares the follower's own clock."),
    ] = None,
    csv_path: Annotated[Path | None, about_file("Write the table to this file.", "--csv")] = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Compare a master's clock with that of a follower in another process (Table II of paper B)."""
    say(f"{steps} steps")
    found = measure_drift(world, steps=steps, rogue=rogue, answer=own_ticks, pace=pace)
    if csv_path is not None:
        write_rows(csv_path, found.rows)
    title = f"{found.environment}, {1000.0 * found.dt_s:g} ms per step"
    return drift_report(found, title, ("master", "follower"), [_verdict(found)])


def _verdict(found: ClockDrift) -> str:
    if not found.own_ticks:
        equal = "equal" if found.holds else "[bold]not equal[/]"
        return f"the follower did not tick on its own; the clocks are {equal}"
    event = f"the follower ticked on its own {found.own_ticks} times ({found.answer})"
    if found.noticed_ticks is None:
        return f"{event}; the master counted {found.counted}, and only the master ticked the world"
    return (
        f"{event}; the master noticed {found.drift_events} times that the world advanced without "
        f"it, for the first time {found.noticed_ticks} ticks after the follower's first own tick"
    )


if __name__ == "__main__":
    run(measure)
