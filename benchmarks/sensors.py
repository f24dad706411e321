"""The sensors of one vehicle over several numbers of sensor workers."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from rich.table import Table

from benchmarks.program import run
from benchmarks.sensor_bench import SensorBench, measure_sensor_workers
from benchmarks.sensor_run import Window, load_rig
from benchmarks.sensor_scaling import MIN_RUNS, ScalingRow, plot_sensor_workers
from cavmarl.bench.harness import BenchmarkReport, Say, is_kept, make_table, numbers_of, silent
from cavmarl.cli.output import OptionalEnvironment, about, about_file, check_bound, with_world
from cavmarl.config.registry import find_settings
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError
from cavmarl.parallel.processes.process_barrier import usable_cores
from cavmarl.parallel.sensor_workers.sensor_shares import Shares

TOWN = "envs/cities_sensed/map/town10hd.net.xml.gz"  # the benchmark map of the papers, by CARLA


@with_world()
def measure(
    world: WorldSpec,
    env: OptionalEnvironment = TOWN,
    workers: Annotated[
        str, about("Comma-separated numbers of sensor workers.", metavar="N,…")
    ] = "1,2,3,4",
    warmup: Annotated[int, about("Unmeasured steps at the beginning.")] = 40,
    steps: Annotated[int, about("Measured steps per run.")] = 150,
    repeats: Annotated[int, about("Runs per number of sensor workers.")] = 5,
    rig: Annotated[str, about("Rig: a name in configs/rigs/, or a .yaml file.")] = "ten_sensors",
    agents: Annotated[int, about("Number of vehicles with sensors.")] = 1,
    background: Annotated[int, about("Number of vehicles without sensors.")] = 0,
    csv_path: Annotated[
        Path | None, about_file("Write every step of every run to this file.", "--csv")
    ] = None,
    plot: Annotated[Path | None, about_file("Write a figure (.png, .svg, .pdf).")] = None,
    at_least: Annotated[
        float | None,
        about(
            "Exit with 1 if the second of --workers is not this many times faster than the first.",
            callback=check_bound,
        ),
    ] = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Run one vehicle and its sensors with each number of sensor workers, in new processes.

    Exit with 1 if states or frames differ between runs, or if --at-least does not hold.
    """
    mounted = load_rig(find_settings("rig", rig))
    found = measure_sensor_workers(
        world,
        mounted,
        workers=numbers_of("--workers", workers),
        warmup=warmup,
        steps=steps,
        repeats=repeats,
        say=say,
    )
    rows = found.rows
    if csv_path is not None:
        _write_csv(csv_path, found)
    if plot is not None:
        title = f"{Path(env).stem}: {len(found.costs_ms)} sensors, {found.sensing_ms:.1f} ms a tick"
        plot_sensor_workers(rows, title, plot)
    speedup = rows[1].speedup if len(rows) > 1 else None
    return BenchmarkReport(
        f"{Path(found.env).stem}, {found.agents} vehicles with sensors, {found.warmup} + "
        f"{found.steps} steps, placed by {found.placement}",
        {"sensor\nworkers": "name", **_FIGURES},
        [{"name": _name(row), **asdict(row)} for row in rows],
        notes=_notes(found, rows),
        facts=found.facts(),
        holds=found.is_same and is_kept(at_least, speedup),
        caption="best: the fastest measured number of workers; SD: of the steps of a run",
        tables=(_sensors(found), _parts(found), _resources(found)),
    )


def _name(row: ScalingRow) -> str:
    return f"{row.workers} (best)" if row.is_best else str(row.workers)


def _sensors(found: SensorBench) -> Table:
    shared = [number for number in found.numbers if number > 1]
    plans = [found.shares(number) for number in shared]
    homes = [{name: _homes(plan) for name, plan in both.items()} for both in plans]
    rows: list[tuple[str, ...] | None] = []
    sensors = zip(found.turns[0].run.sensors, found.costs_ms, strict=True)
    for place, (sensor, cost_ms) in enumerate(sensors):
        at = sensor["placement"]
        rows.append(
            (
                sensor["name"],
                sensor["type"],
                " by ".join(map(str, sensor["resolution"])),
                "" if sensor["rate_hz"] is None else f"{sensor['rate_hz']:g}",
                f"{at['x_m']:g}, {at['y_m']:g}, {at['z_m']:g}; {at['yaw_deg']:g}",
                f"{cost_ms:.3f}",
                *(
                    " / ".join(both[n].get(place, "-") for n in ("in_turn", "cost"))
                    for both in homes
                ),
            )
        )
    slowest = (
        " / ".join(f"{1e3 * max(both[name].loads_s):.2f}" for name in ("in_turn", "cost"))
        for both in plans
    )
    rows += [None, ("sum; slowest worker", "", "", "", "", f"{sum(found.costs_ms):.3f}", *slowest)]
    return make_table(
        "the rig",
        (
            "sensor", "type", "sample", "Hz", "x, y, z m; yaw °", "ms",
            *(f"worker of {number}: in turn / by cost" for number in shared),
        ),
        rows,
    )  # fmt: skip


def _homes(plan: Shares) -> dict[int, str]:
    """Return the workers that write each sensor's frames, or parts of them."""
    homes: dict[int, list[str]] = {}
    for unit, home in zip(plan.units, plan.homes, strict=True):
        homes.setdefault(unit.sensor, []).append(str(home))
    return {sensor: "+".join(own) for sensor, own in homes.items()}


_FIGURES = {
    "FPS": "fps:.2f",
    "tick +\nsensors\nms": "step_ms:.2f",
    "SD\nms": "sd_within_run:.2f",
    "wait\nms": "wait_ms:.2f",
    "speedup": "speedup:.2f",
    "effi-\nciency\n%": "efficiency_pct:.2f",
    "CV\n%": "cv_pct:.2f",
    "wait\n%": "wait_share_pct:.2f",
    "rest\nms": "rest_ms:.2f",
}


def _parts(found: SensorBench) -> Table:
    columns = [(found.parts_ms(row.workers), row.step_ms) for row in found.rows]
    rows: list[tuple[str, ...] | None] = [
        (name, *(f"{parts[name]:.3f}" for parts, _ in columns))
        for name in columns[0][0]
        if name != "SUMO" or any(parts[name] for parts, _ in columns)
    ]
    sums = (f"{sum(parts.values()) / step_ms:.1%}" for parts, step_ms in columns)
    rows += [None, ("sum, of the step", *sums)]
    head = ("ms a step", *(str(row.workers) for row in found.rows))
    return make_table("parts of a step, timed separately", head, rows)


_RESOURCES: dict[str, Callable[[Window], float]] = {
    "processor, state, ms": lambda w: 1e3 * w.leader_cpu_s / w.steps,
    "processor, sensor workers, ms": lambda w: 1e3 * sum(w.worker_cpu_s) / w.steps,
    "memory, state, MB": lambda w: w.leader_rss_mb,
    "memory, largest sensor worker, MB": lambda w: max(w.worker_rss_mb),
    "to sensor workers, kB": lambda w: 1e-3 * w.sent_bytes / w.steps,
    "frames, kB": lambda w: 1e-3 * w.got_bytes / w.steps,
    "messages": lambda w: w.messages / w.steps,
}


def _resources(found: SensorBench) -> Table:
    last = [found.windows(number)[-1] for number in found.numbers]
    rows = [
        (name, *(f"{value(window):,.1f}" for window in last)) for name, value in _RESOURCES.items()
    ]
    return make_table("resources", ("per step", *map(str, found.numbers)), rows)


def _notes(found: SensorBench, rows: list[ScalingRow]) -> list[str]:
    best = next(row for row in rows if row.is_best)
    intervals = [
        f"{row.workers}: {row.ci95_between_runs.low:.2f} to {row.ci95_between_runs.high:.2f} ms"
        for row in rows
        if row.ci95_between_runs is not None
    ]
    lines = [
        f"the best number: [bold]{best.workers}[/] sensor workers, {best.speedup:.2f} "
        f"times as fast as {rows[0].workers}; sensing takes {found.sensing_ms:.2f} ms per tick on "
        f"{rows[0].workers}",
        f"95 % between runs: {'; '.join(intervals) or f'none, needs {MIN_RUNS} runs'}",
        "states and frames of all runs, step by step: "
        + ("the same" if found.is_same else "[red]not the same[/]"),
    ]
    if found.ceiling is not None:
        lines.append(
            f"{found.ceiling.programs} independent programs with the same work, side by side: "
            f"[bold]{found.ceiling.ratio:.2f}[/] times as fast as one after the other; this is the "
            "machine's limit"
        )
    cores = len(usable_cores())
    order = ", ".join(str(turn.workers) for turn in found.turns)
    lines.append(f"cores: {cores}; runs in this order: {order}")
    crowded = [number for number in found.numbers if number > cores]
    if crowded:
        counts = ", ".join(map(str, crowded))
        lines.append(f"[yellow]note: {counts} are more sensor workers than cores[/]")
    return lines


def _write_csv(path: Path, found: SensorBench) -> None:
    """Write the raw series, one line per step."""
    parts = list(found.turns[0].run.parts_ms)
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["place", "repeat", "workers", "step", "step_ms", "wait_ms", *parts])
            for turn in found.turns:
                run = turn.run
                columns = (run.step_ms, run.wait_ms, *(run.parts_ms[name] for name in parts))
                for step, values in enumerate(zip(*columns, strict=True), 1):
                    writer.writerow([turn.place, turn.repeat, turn.workers, step, *values])
    except OSError as error:
        raise ConfigError(f"--csv {path}: cannot be written ({error.strerror})") from error


if __name__ == "__main__":
    run(measure)
