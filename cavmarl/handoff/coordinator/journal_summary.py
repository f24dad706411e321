"""What a journal tells: counts of all events, and the owners at each tick."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cavmarl.core.errors import JournalError, ProtocolError
from cavmarl.handoff.coordinator.journal import JournalReader
from cavmarl.ownership.messages import Begin, Commit, Fence, Host, Record, Reset
from cavmarl.ownership.table import Table


@dataclass
class JournalSummary:
    """What a journal tells, as far as it was committed."""

    run: str = ""  # which one, in hex
    lines: int = 0
    episodes: int = 0  # that began
    ticks: int = 0  # that were committed
    first_tick: int = -1  # the first of them; ticks are not numbered anew at a reset
    last_tick: int = -1  # the last of them
    births: int = 0  # vehicles that entered
    removals: int = 0  # vehicles that left
    switches: int = 0  # changes of owner
    forced: int = 0  # of these with the state attached, since the target was not ready in time
    # ticks that vehicles stayed with a zone that did not contain them, all together
    deferrals: int = 0
    hosts: int = 0  # processes that were given a zone
    fences: int = 0  # processes that were given up
    unfinished: int = -1  # the tick that was begun and not committed, or -1
    torn: str = ""  # a last line that is cut short, or nothing

    def to_dict(self) -> dict[str, Any]:
        return vars(self).copy()

    def _committed(self, begin: Begin, commit: Commit) -> None:
        if not self.ticks:
            self.first_tick = commit.tick
        self.last_tick = commit.tick
        self.ticks += 1
        self.births += len(begin.births)
        self.removals += len(commit.removed)
        self.switches += len(begin.switches)
        self.forced += sum(switch.forced for switch in begin.switches)
        self.deferrals += len(begin.deferred)
        self.unfinished = -1


def summarize(path: Path) -> tuple[JournalSummary, Table]:
    """A journal's summary, and the table of owners and hosts that it leads to.

    Raises:
        JournalError: it cannot be read, is damaged, or was not written by a coordinator.
    """
    zones = _zones(path)
    summary, table = JournalSummary(), Table(zones)
    reader = JournalReader(path, drop_torn=True)
    for record in reader:
        begun = table.plan
        _apply(table, record, reader)
        match record:
            case Reset():
                summary.run = record.run.hex()
                summary.episodes += 1
                summary.unfinished = -1
            case Begin():
                summary.unfinished = record.tick
            case Commit() if begun is not None:
                summary._committed(begun.record, record)
            case Host():
                summary.hosts += 1
            case Fence():
                summary.fences += 1
    summary.lines, summary.torn = reader.lines, reader.torn
    return summary, table


def owners_at(path: Path, tick: int) -> Table:
    """The table as of the commit of a tick."""
    table, reader = Table(_zones(path)), JournalReader(path, drop_torn=True)
    for record in reader:
        _apply(table, record, reader)
        if isinstance(record, Commit) and record.tick == tick:
            return table
    raise JournalError(f"{path}: tick {tick} was not committed; the last one is {table.tick}")


def _apply(table: Table, record: Record, reader: JournalReader) -> None:
    try:
        table.apply(record)
    except ProtocolError as error:
        raise JournalError(f"{reader.path}: line {reader.lines} of the log: {error}") from error


def _zones(path: Path) -> set[int]:
    """Zones that ever had a host."""
    reader = JournalReader(path, drop_torn=True)
    zones = set()
    for record in reader:
        if reader.lines == 1 and not isinstance(record, Reset):
            raise JournalError(f"{path}: a journal begins with a RESET, which names the run")
        if isinstance(record, Host):
            zones.add(record.zone)
    if not reader.lines:
        raise JournalError(f"{path}: has no whole line")
    return zones
