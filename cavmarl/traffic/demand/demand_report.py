"""`DemandReport`: what was found in demand files, and what was tolerated in them."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Tally:
    """How often something was tolerated, and where first."""

    count: int
    first: str


@dataclass
class DemandReport:
    """Counts of one reading."""

    files: list[str] = field(default_factory=list)  # that were read, in order
    # number of elements by what they are: "vehicle", "flow", "route", …
    read: dict[str, int] = field(default_factory=dict)
    # what was left out or taken for something near, by a sentence that says so
    tolerated: dict[str, Tally] = field(default_factory=dict)

    def count(self, kind: str) -> None:
        self.read[kind] = self.read.get(kind, 0) + 1

    def tolerate(self, what: str, place: str, count: int = 1) -> None:
        """More occurrences of something that was let pass."""
        tally = self.tolerated.setdefault(what, Tally(0, place))
        tally.count += count

    def lines(self) -> list[str]:
        """What was tolerated: how often, what, and where first."""
        return [
            f"{tally.count:>8} {what} (first: {tally.first})"
            for what, tally in sorted(self.tolerated.items())
        ]

    def to_report(self) -> str:
        """Lines for a terminal: what was read, then what was tolerated and where first."""
        lines = [f"read {path}" for path in self.files]
        lines += [f"  {count:>8} {kind}" for kind, count in sorted(self.read.items())]
        if self.tolerated:
            lines.append("tolerated")
        lines += [f"  {line}" for line in self.lines()]
        return "\n".join(lines)
