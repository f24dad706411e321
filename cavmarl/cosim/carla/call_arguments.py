"""Checks of the arguments of calls: each check returns a value of the right type or raises.

Lists of fields may be longer than required: other versions of the client add fields at the end.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

from cavmarl.cosim.carla.carla_geometry import CarlaPose

Check: TypeAlias = Callable[[Any], Any]

FARTHEST_M = 1e6  # largest coordinate
_MAX_ID = (1 << 32) - 1
_SHOWN = 60


class CallRefused(Exception):
    """A call that cannot be carried out; the client gets the message as an error."""


def number(value: Any) -> float:
    """Return a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise CallRefused(f"{shown(value)} is not a finite number")
    return float(value)


def whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise CallRefused(f"{shown(value)} is not a whole number")
    return value


def actor_id(value: Any) -> int:
    if not 0 <= whole(value) <= _MAX_ID:
        raise CallRefused(f"{shown(value)} is not the id of an actor")
    return int(value)


def flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise CallRefused(f"{shown(value)} is not true or false")
    return value


def text(value: Any) -> str:
    if not isinstance(value, str):
        raise CallRefused(f"{shown(value)} is not a text")
    return value


def anything(value: Any) -> Any:
    """Accept any value, for calls without effect."""
    return value


def listed(check: Check, most: int = 1 << 16) -> Check:
    """Return a check for a list of at most `most` elements that all pass `check`."""

    def checked(value: Any) -> list[Any]:
        if not isinstance(value, list):
            raise CallRefused(f"{shown(value)} is not a list")
        if len(value) > most:
            raise CallRefused(f"a list of {len(value)} elements is too long; {most} are allowed")
        return [check(one) for one in value]

    return checked


def record_of(*checks: Check, required: int | None = None) -> Check:
    """Return a check for a list of fields; the first `required` fields must be present."""
    fewest = len(checks) if required is None else required

    def checked(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list) or len(value) < fewest:
            raise CallRefused(f"{shown(value)} is not a list of at least {fewest} fields")
        return tuple(check(one) for check, one in zip(checks, value, strict=False))

    return checked


def optional(check: Check) -> Check:
    """Return a check for an optional value: `[false]` or `[true, value]`."""

    def checked(value: Any) -> Any:
        match value:
            case [False]:
                return None
            case [True, one]:
                return check(one)
        raise CallRefused(f"{shown(value)} is not an optional value")

    return checked


def coordinate(value: Any) -> float:
    if abs(number(value)) > FARTHEST_M:
        raise CallRefused(f"{shown(value)} is beyond {FARTHEST_M:g} m")
    return float(value)


vector = record_of(number, number, number)
place = record_of(coordinate, coordinate, coordinate)


def pose(value: Any) -> CarlaPose:
    """Return a pose within the bounds of the world."""
    (x, y, z), (pitch, yaw, roll) = record_of(place, vector)(value)
    return CarlaPose(x, y, z, pitch, yaw, roll)


def shown(value: Any) -> str:
    """Return the start of a value's text, for messages."""
    written = repr(value)
    return written if len(written) <= _SHOWN else written[:_SHOWN] + "…"
