"""`cavmarl journal`: replays the log of ownership and prints the owners."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import JsonPath, about, grid, pairs_grid, write_json

if TYPE_CHECKING:
    from cavmarl.handoff.coordinator.journal_summary import JournalSummary
    from cavmarl.ownership.table import Table as OwnerTable


def journal(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="Journal of a run.", exists=True, dir_okay=False),
    ],
    at: Annotated[
        int | None, about("Print the owners at this tick [default: at the end].", metavar="TICK")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Replay the ownership log of a divided run: hand-offs, hosts and owners."""
    from cavmarl.handoff.coordinator.journal_summary import owners_at, summarize

    console = Console()
    if at is not None:
        table = owners_at(file, at)
        console.print(_owners(table))
        write_json(json_path, {"tick": table.tick, "owners": _rows(table)})
        return
    summary, table = summarize(file)
    console.print(_counts(summary))
    console.print(_zones(table))
    if summary.unfinished >= 0:
        console.print(f"note: tick {summary.unfinished} was started but not committed")
    if summary.torn:
        console.print(
            f"note: {escape(summary.torn)}; it is ignored", soft_wrap=True, style="yellow"
        )
    write_json(json_path, {**summary.to_dict(), "tick": table.tick, "owners": _rows(table)})


def _rows(table: OwnerTable) -> list[list[int]]:
    """Return rows of vehicle, zone, epoch and ticks of delay, sorted by vehicle."""
    return [
        [vehicle, zone, epoch, table.deferred.get(vehicle, 0)]
        for vehicle, (zone, epoch) in sorted(table.owners.items())
    ]


def _owners(table: OwnerTable) -> Table:
    rows = (list(map(str, row)) for row in _rows(table))
    return grid(("vehicle", "zone", "epoch", "ticks late"), rows, lefts=0)


def _counts(summary: JournalSummary) -> Table:
    span = f", {summary.first_tick} to {summary.last_tick}" if summary.ticks else ""
    moved = f"{summary.switches}, {summary.forced} of them forced; {summary.deferrals} deferred"
    rows = {
        "run": summary.run,
        "lines": f"{summary.lines}",
        "episodes": f"{summary.episodes}",
        "ticks": f"{summary.ticks}{span}",
        "vehicles": f"{summary.births} entered, {summary.removals} left",
        "hand-offs": f"{moved} by a tick",
        "hosts": f"{summary.hosts} named, {summary.fences} fenced",
    }
    return pairs_grid(rows.items())


def _zones(table: OwnerTable) -> Table:
    """Return a table of each zone's host at the end and its number of vehicles."""
    owned = [zone for zone, _ in table.owners.values()]
    rows = [
        (*map(str, (zone, owned.count(zone), *host)), table.states[zone].name.lower())
        for zone, host in table.hosts.items()
    ]
    return grid(("zone", "vehicles", "worker", "incarnation", "state"), rows, lefts=0)
