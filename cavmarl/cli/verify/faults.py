"""Prints the results of `cavmarl verify --faults`: injected faults, and their cost."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import pairs_grid, write_json
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError
from cavmarl.core.progress import counting

if TYPE_CHECKING:
    from cavmarl.verify.equivalence import Equivalence
    from cavmarl.verify.fault_campaign import Campaign, LineResult
    from cavmarl.verify.fault_figures import FaultFigures


def check_campaign(layout: str | None, worlds: int, journal: Path | None) -> None:
    """Refuse what a campaign cannot take."""
    if layout is not None:
        raise ConfigError("--layout: a campaign takes --set zones.layout=… instead")
    if worlds != 1:
        raise ConfigError(f"--worlds {worlds}: hosts die in one world at a time; leave it out")
    if journal is not None:
        raise ConfigError("--journal: a campaign is many runs; give --faults a plan instead")


def print_figures(console: Console, found: Equivalence) -> None:
    """Of each number of zones, what faults did."""
    for result in found.results:
        if result.zones > 1:
            console.print(f"\n{result.zones} zones", style="bold")
            console.print(_figures(result.figures))


def verify_campaign(
    console: Console, world: WorldSpec, json_path: Path | None, **runs: Any
) -> None:
    """The whole matrix of faults: a table by line, then what it took; exit code 1 if one fails."""
    from cavmarl.verify.fault_campaign import run_campaign
    from cavmarl.verify.fault_matrix import ELSEWHERE

    with counting(console, "faults beside the undivided world") as progress:
        campaign = run_campaign(world, progress=progress, **runs)
    write_json(json_path, campaign.to_dict())
    console.print(_lines(campaign, world.seed))
    console.print(_figures(campaign.total()))
    console.print(_steps(campaign))
    for line in campaign.lines:
        _print_notes(console, line)
    for what, where in ELSEWHERE:
        console.print(f"not counted here: {what} ({where})", soft_wrap=True, highlight=False)
    if not campaign.holds:
        raise typer.Exit(1)


def _lines(campaign: Campaign, seed: int) -> Table:
    zones = ", ".join(map(str, campaign.zones))
    table = Table(
        title=escape(
            f"{Path(campaign.env).name}, {zones} zones, {campaign.ticks} ticks a run, seed {seed}"
        ),
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    table.add_column("fault", ratio=1)
    for heading in ("runs", "injected", "survived", "late", "forced"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    for name in dict.fromkeys(line.name for line in campaign.lines):
        table.add_row(*_line([line for line in campaign.lines if line.name == name]))
    return table


def _line(lines: list[LineResult]) -> tuple[str, ...]:
    """A line with all numbers of zones."""
    figures = type(lines[0].figures)()
    for line in lines:
        figures.add(line.figures)
    points = " / ".join(dict.fromkeys(line.points for line in lines))
    wrong = any(line.failures for line in lines)
    return (
        f"{lines[0].name} [dim]({points})[/]",
        f"{sum(line.runs for line in lines)}",
        f"{figures.injected:,}",
        f"{sum(line.survived for line in lines):,}",
        f"{figures.hand_overs['late']:,}",
        f"{figures.hand_overs['forced']:,}",
        "[red]different[/]" if wrong else "[green]equal[/]",
    )


def _figures(figures: FaultFigures) -> Table:
    moved, resent = figures.hand_overs, figures.resent
    rows = (
        ("deaths", f"{figures.zone_deaths.total():,} of zones' hosts, "
                   f"{figures.coordinator_deaths.total():,} of coordinators"),
        ("messages", _pairs(figures.messages)),
        ("hand-overs", f"{figures.handed_over:,}, {moved['forced']:,} of them forced; "
                       f"{moved['failed']:,} failed ({figures.failure_rate:.2%})"),
        ("timeouts", f"PREPARE: {resent['PREPARE']:,} sent again, {moved['late']:,} not ready in "
                     f"time; deferral: {moved['deferred']:,} ticks; deadline: "
                     f"{moved['forced']:,} forced; STEP: {resent['STEP']:,} sent again, "
                     f"{moved['asked']:,} states asked for; DONE: {resent['DONE']:,} asked for "
                     "again"),
        ("refused", f"{moved['refused']:,}; withdrawn {moved['aborted']:,}"),
        ("stale", _pairs(figures.stale)),
        ("recovery", f"{_spread(figures.recovery_ms, 'ms')}; the tick begun again "
                     f"{_spread(figures.repeats, 'times')}"),
        ("migration", f"{_spread(figures.waited_ticks, 'ticks')} from the crossing; "
                      f"{_spread(figures.latency_ms, 'ms')}"),
        ("state", _spread(figures.state_bytes, "bytes a transfer")),
    )  # fmt: skip
    return pairs_grid((name, escape(text)) for name, text in rows)


def _steps(campaign: Campaign) -> Table:
    calm = _spread(campaign.calm_ms, "ms without a death")
    return pairs_grid((("step", calm), ("", _spread(campaign.stricken_ms, "ms with a death"))))


def _print_notes(console: Console, line: LineResult) -> None:
    where = f"{line.name}, {line.zones} zones"
    if line.unmet:
        console.print(f"note: {where}: no process reached {', '.join(line.unmet)}", soft_wrap=True)
    if line.missed:
        console.print(f"note: {where}: {line.missed} deaths that were planned did not happen")
    for failure in line.failures:
        text = f"{where}: {failure['wrong']}; plan {failure['plan']}"
        console.print(text, markup=False, soft_wrap=True, style="red")


def _pairs(counts: Counter[tuple[str, str]]) -> str:
    """Kind by kind, what happened to how many."""
    kinds = dict.fromkeys(kind for kind, _ in sorted(counts))
    parts = [
        f"{kind.upper()} "
        + ", ".join(f"{what} {n:,}" for (of, what), n in sorted(counts.items()) if of == kind)
        for kind in kinds
    ]
    return "; ".join(parts) or "none"


def _spread(values: list[float] | list[int], unit: str) -> str:
    from cavmarl.verify.fault_figures import spread

    found = spread(values)
    if found is None:
        return f"no {unit}"
    return f"{found['p50']:.3g} / {found['p95']:.3g} / {found['max']:.3g} {unit} (p50 / p95 / max)"
