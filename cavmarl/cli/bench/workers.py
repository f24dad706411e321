"""`cavmarl bench workers`: how much faster worlds are over several workers."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import (
    Agents,
    Background,
    JsonPath,
    Seed,
    Settings,
    parse_settings,
    write_json,
)
from cavmarl.core.errors import ConfigError

if TYPE_CHECKING:
    from cavmarl.bench.split_speed import SplitSpeed
    from cavmarl.bench.vectorization_speed import VectorizationSpeed
    from cavmarl.bench.worker_speed import WorkerSpeed

__all__ = ["workers"]

AGENTS = 100  # in whose worlds nothing happens
_LIBRARIES = {
    "cavmarl": "cavmarl",
    "gymnasium": "Gymnasium's AsyncVectorEnv",
    "supersuit": "SuperSuit's concat_vec_envs_v1",
}


def workers(
    env: Annotated[
        str, typer.Argument(metavar="[ENV]", help="Name, folder or map file of an environment.")
    ] = "rush",
    worlds: Annotated[int, typer.Option(help="Stepped together.")] = 16,
    count: Annotated[int, typer.Option("--workers", help="That are compared with one.")] = 2,
    agents: Agents = None,
    background: Background = None,
    steps: Annotated[int, typer.Option(help="Of a turn.")] = 20,
    repeats: Annotated[int, typer.Option(help="Turns of each.")] = 7,
    vehicles: Annotated[
        str,
        typer.Option(
            metavar="N,…",
            help="Of one world that is split, too; default: those of the environment.",
        ),
    ] = "",
    zones: Annotated[
        int | None, typer.Option(help="Of the split world; default: one a worker.")
    ] = None,
    seed: Seed = 0,
    settings: Settings = None,
    at_least: Annotated[
        float | None, typer.Option(help="Exit with 1 if several are not so many times faster.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """The same worlds without workers, with one and with several; and one world that is split.

    How much faster several workers are, what an empty order costs, from how many vehicles on it
    pays to split one world, and what 100 agents in whose worlds nothing happens cost in our
    workers, Gymnasium's and SuperSuit's.
    """
    from cavmarl.bench.core_ceiling import measure_ceiling
    from cavmarl.bench.split_speed import measure_splits, split_line
    from cavmarl.bench.vectorization_speed import measure_vectorization
    from cavmarl.bench.worker_speed import measure_workers

    if at_least is not None and not 0.0 < at_least < math.inf:
        raise ConfigError(f"--at-least {at_least:g}: must be a number above 0")
    numbers = _numbers(vehicles)
    console = Console()
    with console.status("") as status:
        found = measure_workers(
            env,
            worlds=worlds,
            workers=count,
            steps=steps,
            repeats=repeats,
            seed=seed,
            agents=agents,
            background=background,
            overrides=parse_settings(settings),
            say=status.update,
        )
        status.update("stepping worlds in programs of their own")
        ceiling = measure_ceiling(
            env,
            worlds=worlds,
            programs=count,
            steps=steps,
            repeats=repeats,
            seed=seed,
            agents=agents,
            background=background,
            overrides=parse_settings(settings),
        )
        splits = measure_splits(
            env,
            numbers,
            zones=zones,
            workers=count,
            agents=agents,
            background=background,
            steps=steps,
            repeats=repeats,
            seed=seed,
            overrides=parse_settings(settings),
            say=status.update,
        )
        vectorization = measure_vectorization(
            workers=count, agents=AGENTS // count * count, repeats=repeats, say=status.update
        )
    line = split_line(splits)
    more = {
        "ceiling": ceiling.to_dict(),
        "splits": [split.to_dict() for split in splits],
        "split_pays_from": line,
        "vectorization": vectorization.to_dict(),
    }
    write_json(json_path, found.to_dict() | more)
    console.print(_table(found))
    low, middle, high, highest = found.barrier_us
    console.print(
        f"{count} workers over one: [bold]{found.ratio:.2f}[/], by the busiest one's processor "
        f"time {found.processor_ratio:.2f}; one worker costs {found.cost_of_one:.2f} times the "
        "step without\n"
        f"an empty order to all {count}: [bold]{middle:.1f}[/] µs "
        f"({low:.1f} / {high:.1f} / {highest:.1f}: 5, 95, 99 %); idle workers take "
        f"{found.idle_s:.1%} of a core",
        highlight=False,
    )
    console.print(
        f"{count} programs that share nothing, side by side: [bold]{ceiling.ratio:.2f}[/] times "
        "one after the other: more this machine does not give",
        highlight=False,
    )
    for split in splits:
        console.print(_sentence(split), highlight=False)
    console.print(_line(line, splits), highlight=False)
    console.print(_vectorization(vectorization), highlight=False)
    if found.is_crowded:
        console.print("note: more workers than cores", style="yellow")
    if at_least is not None and found.ratio < at_least:
        raise typer.Exit(1)


def _numbers(text: str) -> list[int | None]:
    """What `--vehicles` says."""
    if not text:
        return [None]
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise ConfigError(f"--vehicles {text}: must be whole numbers with commas between") from None


def _sentence(split: SplitSpeed) -> str:
    undivided, whole, parted = (
        statistics.median(times) for times in (split.undivided_ms, split.whole_ms, split.split_ms)
    )
    verdict = "faster" if split.ratio > 1.0 else "slower: leave it whole"
    return (
        f"one world of {split.vehicles} vehicles: {undivided:.2f} ms a step; in {split.zones} "
        f"zones over one worker {whole:.2f}, over {split.workers} {parted:.2f}: "
        f"[bold]{split.ratio:.2f}[/] times, {verdict}"
    )


def _line(line: int | None, splits: Sequence[SplitSpeed]) -> str:
    """From where on a world is better split, as far as it was asked."""
    numbers = ", ".join(str(split.vehicles) for split in splits)
    if line is None:
        return f"splitting one world does not pay at {numbers} vehicles here"
    return f"splitting one world pays from {line} vehicles on here (of {numbers})"


def _vectorization(found: VectorizationSpeed) -> str:
    order = statistics.median(found.order_us)
    lines = [
        f"a step of {found.agents} agents over {found.workers} workers in whose worlds nothing "
        f"happens, {found.numbers} numbers each:"
    ]
    for row in found.rows:
        name = _LIBRARIES[row.library]
        if not row.step_us:
            lines.append(f"  {name}: not measured: {row.missing}")
            continue
        took = f"  {name}: [bold]{statistics.median(row.step_us):,.0f}[/] µs"
        if row.library == "cavmarl":
            lines.append(f"{took}, of which the workers take [bold]{order:.0f}[/]")
        else:
            ratio, order_ratio = found.ratio(row.library), found.order_ratio(row.library)
            lines.append(f"{took}, {ratio:.1f} times that, [bold]{order_ratio:.1f}[/] times this")
    return "\n".join(lines)


def _table(found: WorkerSpeed) -> Table:
    hardware = found.hardware
    table = Table(
        "workers",
        title=escape(
            f"{found.env}: {found.worlds} worlds, turns of {found.steps} steps\n"
            f"{hardware['cpu']}, {hardware['usable_cores']} cores"
        ),
    )
    for column in ("made in, s", "step, ms: min", "median", "max", "busiest, ms"):
        table.add_column(column, justify="right")
    for row in found.rows:
        times = (min(row.step_ms), statistics.median(row.step_ms), max(row.step_ms))
        busiest = "-" if row.busiest_ms is None else f"{row.busiest_ms:.2f}"
        shown = (f"{ms:.2f}" for ms in times)
        table.add_row(str(row.workers), f"{row.made_s:.2f}", *shown, busiest)
    return table
