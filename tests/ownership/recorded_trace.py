"""Traces that tests record and check, and logs in text form."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from cavmarl.core.errors import ProtocolError
from cavmarl.ownership.log_records import LogChain
from cavmarl.ownership.messages import Message, Record
from cavmarl.ownership.trace import LOG, TraceEntry, describe
from cavmarl.ownership.trace_check import TraceChecker


@dataclass(slots=True)
class Trace:
    """Log records and delivered messages, in the order of their events."""

    entries: list[TraceEntry] = field(default_factory=list)

    def logged(self, records: Iterable[Record]) -> None:
        self.entries.extend(TraceEntry(LOG, record) for record in records)

    def delivered(self, destination: int, message: Message) -> None:
        """Add a message that is delivered to a zone or to the coordinator."""
        self.entries.append(TraceEntry(destination, message))

    def text(self) -> str:
        return "".join(f"{describe(entry)}\n" for entry in self.entries)


def check_trace(entries: Iterable[TraceEntry], longest_deferral: int, lifetime: int) -> None:
    checker = TraceChecker(longest_deferral, lifetime)
    for number, entry in enumerate(entries, start=1):
        try:
            checker.take(entry)
        except ProtocolError as error:
            raise ProtocolError(f"entry {number}, {describe(entry)}: {error}") from None


def lines_of(records: Iterable[Record]) -> list[str]:
    """Return the lines of a complete log."""
    chain = LogChain()
    return [chain.write(record) for record in records]


def records_from_lines(text: str) -> tuple[Record, ...]:
    chain = LogChain()
    return tuple(chain.read(line) for line in text.splitlines(keepends=True))
