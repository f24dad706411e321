"""Checks of configuration values.

The type of a field contains its range: `Annotated[float, Within(0.0, 1.0)]`. `check_ranges`
reads the range. A class checks conditions on several fields in its own `__post_init__`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from itertools import chain
from operator import attrgetter
from typing import Any, ClassVar, get_args, get_type_hints

from cavmarl.core.errors import ConfigError


@dataclass(frozen=True)
class Within:
    """The range of a number, both ends included."""

    low: float
    high: float

    @property
    def expected(self) -> str:
        """The part of an error message that describes allowed values."""
        return f"must be a number from {self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class Whole(Within):
    """The range of a whole number.

    Attributes:
        note: text that ends the error message.
    """

    low: int
    high: int
    note: str = ""

    @property
    def expected(self) -> str:
        """The part of an error message that describes allowed values."""
        return f"must be a whole number from {self.low} to {self.high}{self.note}"


class Section:
    """Base of configuration classes; `key` is their place in env.yaml.

    Fields are checked against their ranges when an object is created.
    """

    section: ClassVar[str]

    def __init_subclass__(cls, key: str) -> None:
        super().__init_subclass__()
        cls.section = key

    def __post_init__(self) -> None:
        check_ranges(self.section, self)

    def need(self, name: str, holds: bool, expected: str) -> None:
        """Raise a ConfigError for the value at a dotted name of this section unless `holds`."""
        key = f"{self.section}.{name}" if self.section else name
        check(holds, key, attrgetter(name)(self), expected)


def check_ranges(section: str, holder: object) -> None:
    """Raise a ConfigError for a field outside the range in its type; None is allowed."""
    kind: Any = type(holder)
    for name, bounds in _ranges(kind):
        value = getattr(holder, name)
        if value is not None:
            # NaN and infinity are outside of every range.
            fits = bounds.low <= value <= bounds.high
            check(fits, f"{section}.{name}", value, bounds.expected)


@cache
def _ranges(kind: type[Any]) -> tuple[tuple[str, Within], ...]:
    hints = get_type_hints(kind, include_extras=True)
    return tuple(
        (name, mark)
        for name, hint in hints.items()
        # the range is in the hint, or in a member of a union such as `Annotated[int, …] | None`
        for mark in (*get_args(hint), *chain.from_iterable(map(get_args, get_args(hint))))
        if isinstance(mark, Within)
    )


def check(holds: bool, key: str, value: object, expected: str) -> None:
    """Raise a ConfigError that names key, value and expectation unless `holds`."""
    if not holds:
        raise ConfigError(f"{key} = {value!r}: {expected}")


def check_count(key: str, value: Any, most: int) -> None:
    """Raise a ConfigError unless `value` is a whole number from 1 to `most`."""
    whole = isinstance(value, int) and not isinstance(value, bool)
    check(whole, key, value, "must be a whole number")
    check(1 <= value <= most, key, value, f"must be from 1 to {most}")


def check_finite(key: str, value: float, low: float, high: float) -> None:
    """Raise a ConfigError unless `value` is a finite number from `low` to `high`."""
    check(math.isfinite(value) and low <= value <= high, key, value, Within(low, high).expected)
