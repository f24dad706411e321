"""`cavmarl bench workers`: how much faster worlds are over several workers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from rich.console import Console
from rich.table import Table

from cavmarl.bench.harness import hardware_line, make_table, measuring, spread
from cavmarl.cli.output import (
    AtLeast,
    JsonPath,
    OptionalEnvironment,
    about,
    end_below,
    with_world,
    write_json,
)
from cavmarl.config.world_spec import WorldSpec

if TYPE_CHECKING:
    from cavmarl.bench.worker_speed import WorkerSpeed


@with_world()
def workers(
    world: WorldSpec,
    env: OptionalEnvironment = "rush",
    worlds: Annotated[int, about("Number of parallel worlds.")] = 16,
    count: Annotated[int, about("Number of workers to compare with one worker.", "--workers")] = 2,
    steps: Annotated[int, about("Steps in each turn.")] = 20,
    repeats: Annotated[int, about("Turns of each number of workers.")] = 7,
    at_least: AtLeast = None,
    json_path: JsonPath = None,
) -> None:
    """The same worlds without workers, with one and with several; what an empty command costs."""
    from cavmarl.bench.worker_speed import measure_ceiling, measure_workers

    console = Console()
    turns: dict[str, Any] = {"worlds": worlds, "steps": steps, "repeats": repeats}
    with measuring(console) as say:
        found = measure_workers(world, workers=count, say=say, **turns)
        say("stepping worlds in programs of their own")
        ceiling = measure_ceiling(world, programs=count, **turns)
    write_json(json_path, found.to_dict() | {"ceiling": ceiling.to_dict()})
    console.print(_table(found))
    low, middle, high, highest = found.barrier_us
    console.print(
        f"{count} workers over one: [bold]{found.ratio:.2f}[/], by the busiest one's processor "
        f"time {found.processor_ratio:.2f}; one worker costs {found.cost_of_one:.2f} times the "
        "step without\n"
        f"an empty command to all {count}: [bold]{middle:.1f}[/] µs "
        f"({low:.1f} / {high:.1f} / {highest:.1f}: 5, 95, 99 %); idle workers take "
        f"{found.idle_s:.1%} of a core\n"
        f"{count} programs that share nothing, side by side: [bold]{ceiling.ratio:.2f}[/] times "
        "one after the other: more this machine does not give",
        highlight=False,
    )
    if found.is_crowded:
        console.print("note: more workers than cores", style="yellow")
    end_below(at_least, found.ratio)


def _table(found: WorkerSpeed) -> Table:
    rows = []
    for row in found.rows:
        step_ms = spread(row.step_ms)
        busiest = "-" if row.busiest_ms is None else f"{row.busiest_ms:.2f}"
        times = (f"{ms:.2f}" for ms in (row.made_s, step_ms.low, step_ms.median, step_ms.high))
        rows.append((str(row.workers), *times, busiest))
    title = f"{found.env}: {found.worlds} worlds, turns of {found.steps} steps"
    heads = ("workers", "made in, s", "step, ms: min", "median", "max", "busiest, ms")
    return make_table(f"{title}\n{hardware_line(found.hardware)}", heads, rows)
