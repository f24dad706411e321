"""Summary of a journal: counts of events, and the owners at each tick."""

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
    """Counts of the committed events in a journal."""

    run: str = ""  # id of the run, in hex
    lines: int = 0
    episodes: int = 0  # episodes that began
    ticks: int = 0  # committed ticks
    first_tick: int = -1  # the first committed tick; a reset does not restart the numbers
    last_tick: int = -1  # the last committed tick
    births: int = 0  # vehicles that entered
    removals: int = 0  # vehicles that left
    switches: int = 0  # changes of owner
    # changes of owner that carried the vehicle's state, since the target was not ready in time
    forced: int = 0
    deferrals: int = 0  # ticks that vehicles spent with an owner whose zone they had left, summed
    hosts: int = 0  # assignments of a zone to a process
    fences: int = 0  # processes that were fenced: their messages are dropped
    unfinished: int = -1  # the tick that was begun but not committed; -1: none
    torn: str = ""  # an incomplete last line; empty: none

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
    """Return a journal's summary, and its final table of owners and hosts.

    Raises:
        JournalError: the journal cannot be read, is damaged, or is not a coordinator's journal.
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
    """Return the table of owners at the commit of a tick."""
    table, reader = Table(_zones(path)), JournalReader(path, drop_torn=True)
    for record in reader:
        _apply(table, record, reader)
        if isinstance(record, Commit) and record.tick == tick:
            return table
    raise JournalError(
        f"{path}: tick {tick} was not committed; use a tick up to the last one, {table.tick}"
    )


def _apply(table: Table, record: Record, reader: JournalReader) -> None:
    try:
        table.apply(record)
    except ProtocolError as error:
        raise JournalError(f"{reader.path}: line {reader.lines} of the log: {error}") from error


def _zones(path: Path) -> set[int]:
    """Return the zones that ever had a host."""
    reader = JournalReader(path, drop_torn=True)
    zones = set()
    for record in reader:
        if reader.lines == 1 and not isinstance(record, Reset):
            raise JournalError(f"{path}: the first line is not a RESET, which has the run's id")
        if isinstance(record, Host):
            zones.add(record.zone)
    if not reader.lines:
        raise JournalError(f"{path}: the journal has no complete line; use the journal of a run")
    return zones
