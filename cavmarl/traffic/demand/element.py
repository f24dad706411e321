"""`Element`: an XML element with its place in the file, and checked access to attributes.

`DemandReport` counts what was read from demand files and what was tolerated.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path

from cavmarl.core.errors import CavmarlError, DemandError

# A century: later times are mistakes, and earlier times cannot overflow integers.
MAX_TIME_MS = 100 * 366 * 86_400_000

_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_WHOLE = re.compile(r"[+-]?[0-9]{1,18}")
_TRUE = frozenset(("true", "1", "yes", "y", "t", "on", "x"))
_FALSE = frozenset(("false", "0", "no", "n", "f", "off", "-"))
_UNIT_MS = (1000, 60_000, 3_600_000, 86_400_000)


def parse_time_ms(text: str) -> int | None:
    """Parse "12.5", "HH:MM:SS" or "D:HH:MM:SS" to ms, rounded as in SUMO; None: not a time."""
    parts = text.strip().split(":")
    if len(parts) not in (1, 3, 4) or not all(map(_NUMBER.fullmatch, parts)):
        return None
    total = sum(float(part) * unit for part, unit in zip(reversed(parts), _UNIT_MS, strict=False))
    if not abs(total) <= MAX_TIME_MS:
        return None
    return math.floor(abs(total) + 0.5) * (-1 if total < 0.0 else 1)


def near(name: str, known: Iterable[str]) -> str:
    """Return names similar to an unknown one, for the end of a message."""
    names = list(known)
    matches = get_close_matches(name, names, n=3) or names[:3]
    return f"similar names: {', '.join(matches)}" if matches else "the files define none"


def late_begin(begin_s: float, horizon_s: float, first_ms: int, stays: bool) -> str:
    """Describe a demand in which no vehicle departs between `begin_s` and `begin_s + horizon_s`.

    `first_ms`: time of the first departure. `stays`: whether the episode begins at `begin_s`
    nevertheless, instead of at the first departure.
    """
    none = f"no vehicle departs from {begin_s:g} s to {begin_s + horizon_s:g} s"
    if stays:
        return f"{none}, only from {first_ms // 1000} s: change horizon_s, or the .sumocfg's begin"
    return f"the demand begins at {first_ms // 1000} s, as {none}"


def _or(words: Iterable[str]) -> str:
    return "".join(f" or {word}" for word in words)


@dataclass(slots=True)
class Element:
    """An XML element with its place."""

    name: str  # name of the tag
    attrs: dict[str, str]  # attributes as written
    path: str  # path of the file
    line: int  # line of the start tag
    children: list[Element] = field(default_factory=list)  # direct children, in order

    @property
    def place(self) -> str:
        return f"{self.path}, line {self.line}"

    def error(
        self, problem: str, cure: str, failure: type[CavmarlError] = DemandError
    ) -> CavmarlError:
        """Return an error that states the problem, this element, its place and the cure."""
        known = f' id="{self.attrs["id"]}"' if "id" in self.attrs else ""
        return failure(f"{self.place}: <{self.name}{known}> {problem}: {cure}")

    def with_attrs(self, **attrs: str) -> Element:
        """Return this element with other attributes, for checking parts of a value."""
        kept = {key: self.attrs[key] for key in ("id",) if key in self.attrs}
        return Element(self.name, {**kept, **attrs}, self.path, self.line)

    def text(self, key: str) -> str:
        """Return a required attribute that is not empty."""
        value = self.attrs.get(key, "").strip()
        if not value:
            raise self.error(f"has no {key}", f"give it the attribute '{key}'")
        return value

    def number(
        self,
        key: str,
        default: float,
        *,
        least: float = -math.inf,
        above: float = -math.inf,
        most: float = math.inf,
        words: Iterable[str] = (),
    ) -> float:
        """Return a finite number in [least, most] and greater than `above`.

        `words`: keywords that are also allowed, for the error message.
        """
        if key not in self.attrs:
            return default
        text = self.attrs[key]
        value = float(text) if _NUMBER.fullmatch(text.strip()) else math.nan
        if not math.isfinite(value):
            raise self.error(f"has {key}='{text}'", "write a finite number" + _or(words))
        if value < least or value > most or value <= above:
            low = f"above {above:g}" if above > least else f"at least {least:g}"
            high = f" and at most {most:g}" if most < math.inf else ""
            raise self.error(f"has {key}='{text}'", f"it must be {low}{high}")
        return value

    def whole(self, key: str, default: int, *, least: int, words: Iterable[str] = ()) -> int:
        if key not in self.attrs:
            return default
        text = self.attrs[key].strip()
        if not _WHOLE.fullmatch(text) or int(text) < least:
            cure = f"write a whole number of at least {least}" + _or(words)
            raise self.error(f"has {key}='{text}'", cure)
        return int(text)

    def flag(self, key: str, default: bool) -> bool:
        """Return a boolean in any of SUMO's spellings."""
        if key not in self.attrs:
            return default
        text = self.attrs[key].strip().lower()
        if text not in _TRUE and text not in _FALSE:
            raise self.error(f"has {key}='{self.attrs[key]}'", "write true or false")
        return text in _TRUE

    def time_ms(self, key: str, default: int | None = None) -> int:
        """Return a non-negative time in milliseconds."""
        if key not in self.attrs and default is not None:
            return default
        text = self.text(key)
        value = parse_time_ms(text)
        if value is None:
            raise self.error(f"has {key}='{text}'", "write seconds, HH:MM:SS or D:HH:MM:SS")
        if value < 0:
            raise self.error(f"has the negative time {key}='{text}'", "start at 0 or later")
        return value

    def params(self) -> dict[str, str]:
        return {
            child.attrs.get("key", ""): child.attrs.get("value", "")
            for child in self.children
            if child.name == "param"
        }


@dataclass
class Tally:
    """The number of tolerated cases of one kind, and the place of the first case."""

    count: int
    first: str


@dataclass
class DemandReport:
    """Counts of the elements that were read or tolerated."""

    files: list[str] = field(default_factory=list)  # files that were read, in order
    # number of elements by kind: "vehicle", "flow", "route", …
    read: dict[str, int] = field(default_factory=dict)
    # omissions and replacements, by a phrase that describes them
    tolerated: dict[str, Tally] = field(default_factory=dict)
    program_files: frozenset[Path] = frozenset()  # files whose signal programs are read elsewhere

    def count(self, kind: str) -> None:
        self.read[kind] = self.read.get(kind, 0) + 1

    def tolerate(self, what: str, place: str, count: int = 1) -> None:
        """Count occurrences of a tolerated problem."""
        tally = self.tolerated.setdefault(what, Tally(0, place))
        tally.count += count

    def lines(self) -> list[str]:
        """Return the count, description and first place of each tolerated problem."""
        return [
            f"{tally.count:>8} {what} (first: {tally.first})"
            for what, tally in sorted(self.tolerated.items())
        ]

    def to_report(self) -> str:
        """Return lines for a terminal: what was read, then what was tolerated."""
        lines = [f"read {path}" for path in self.files]
        lines += [f"  {count:>8} {kind}" for kind, count in sorted(self.read.items())]
        if self.tolerated:
            lines.append("tolerated")
        lines += [f"  {line}" for line in self.lines()]
        return "\n".join(lines)
