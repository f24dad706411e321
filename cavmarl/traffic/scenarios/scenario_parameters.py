"""Parameters of scenarios: dataclass fields that know their range, their unit and what they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import Field, field, fields
from difflib import get_close_matches
from math import isfinite
from typing import Any, TypeVar

from cavmarl.core.errors import ConfigError

T = TypeVar("T")


def setting(default: float, low: float, high: float, unit: str, what: str) -> Any:
    metadata = {"low": low, "high": high, "unit": unit, "what": what}
    return field(default=default, metadata=metadata)


def switch(default: bool, what: str) -> Any:
    return field(default=default, metadata={"unit": "", "what": what})


def describe(parameters: type[Any]) -> list[tuple[str, str, str, str]]:
    """(name, default, range with unit, what it is) of each parameter of a dataclass."""
    return [(f.name, f"{f.default:g}" if _is_number(f) else str(f.default).lower(), _range(f),
             f.metadata["what"]) for f in fields(parameters)]  # fmt: skip


def checked(parameters: type[T], given: Mapping[str, bool | float], scenario: str) -> T:
    """The parameters of a scenario with the given values.

    `parameters`: a dataclass of `setting`s and `switch`es. `given`: value by name.

    Raises ConfigError: a name that it does not have, or a value out of range.
    """
    kind: Any = parameters
    known = {f.name: f for f in fields(kind)}
    for name, value in given.items():
        where = f"scenario.params.{name} = {value!r}"
        if name not in known:
            close = get_close_matches(name, known, n=1)
            hint = f"did you mean {close[0]}?" if close else f"it has {', '.join(known)}"
            raise ConfigError(f"{where}: scenario '{scenario}' has no such parameter; {hint}")
        about = known[name]
        if isinstance(value, bool) is _is_number(about):
            raise ConfigError(f"{where}: must be {_range(about)}")
        if _is_number(about):
            low, high = about.metadata["low"], about.metadata["high"]
            if not (isfinite(value) and low <= value <= high):
                raise ConfigError(f"{where}: must be {_range(about)}")
    made: T = kind(**given)
    return made


def _is_number(about: Field[Any]) -> bool:
    return "low" in about.metadata


def _range(about: Field[Any]) -> str:
    if not _is_number(about):
        return "true or false"
    low, high, unit = (about.metadata[key] for key in ("low", "high", "unit"))
    return f"{low:g} to {high:g} {unit}".rstrip()
