"""Requests of a page to a running world: JSON objects with a `kind`, validated before use."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from cavmarl.core.errors import MessageError

MAX_TEXT = 4096
MAX_PACE = 1000.0
# Kinds that change the world or its clock; the others affect only the page itself.
CONTROLS = frozenset(
    {"pause", "play", "step", "pace", "reset", "seat", "drive", "seek", "insert", "close", "open"}
)
MAX_PLACE_M = 1e7
_SHOWN_DIGITS = 10


@dataclass(frozen=True)
class PageRequest:
    """One request of a page.

    Attributes:
        kind: `watch` (a vehicle), `ghosts` (mark the ghosts of a zone), or one of `CONTROLS`:
            `pause`, `play`, `step`, `pace`, `reset`, `seat` (take the seat of an agent), `drive`
            (in that seat), `seek` (a tick of a recording), `insert` (a vehicle at a position),
            `close` and `open` (the road at a position).
        number: the vehicle, zone, agent or tick, None for none; for `pace`, simulated seconds per
            second, 0 for as fast as possible.
        x: position, m from the map's origin.
        y: position, m from the map's origin.
        sensors: whether to send the sensor data of a watched vehicle.
        throttle: within [-1, 1].
        steering: within [-1, 1], positive to the left.
    """

    kind: str
    number: float | None = None
    throttle: float = 0.0
    steering: float = 0.0
    sensors: bool = False
    x: float = 0.0
    y: float = 0.0


def read_object(text: str) -> dict[str, Any]:
    """Parse a JSON object sent by a page.

    Raises MessageError: the text is not a JSON object, or is too long.
    """
    if len(text) > MAX_TEXT:
        raise MessageError(f"request of {len(text)} characters: at most {MAX_TEXT} are allowed")
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise MessageError("the request is not valid JSON") from error
    if not isinstance(found, dict):
        raise MessageError(f"the request is a {type(found).__name__}: it must be an object")
    return found


def read_request(text: str) -> PageRequest:
    """Parse a request of a page.

    Raises MessageError: the request is invalid.
    """
    found = read_object(text)
    kind = found.get("kind")
    if kind in ("pause", "play", "step", "reset"):
        return PageRequest(kind)
    if kind in ("watch", "ghosts", "seat"):
        number = found.get("number")
        whole = None if number is None else _whole(kind, number)
        return PageRequest(kind, whole, sensors=found.get("sensors") is True)
    if kind == "seek":
        return PageRequest(kind, _whole(kind, found.get("number")))
    if kind == "pace":
        return PageRequest(kind, _within(kind, found.get("number"), 0.0, MAX_PACE))
    if kind == "drive":
        throttle = _within("throttle", found.get("throttle"), -1.0, 1.0)
        steering = _within("steering", found.get("steering"), -1.0, 1.0)
        return PageRequest(kind, None, throttle, steering)
    if kind in ("insert", "close", "open"):
        x, y = (_within(name, found.get(name), -MAX_PLACE_M, MAX_PLACE_M) for name in ("x", "y"))
        return PageRequest(kind, x=x, y=y)
    raise MessageError(f"request of kind {str(kind)[:40]!r}: unknown kind")


def _whole(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**53:
        raise MessageError(f"{name}: must be a whole number of at least 0, or null")
    return value


def _within(name: str, value: Any, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise MessageError(f"{name}: must be a number")
    if not low <= value <= high:
        shown = f"{value:g}" if isinstance(value, float) else _shortened(str(value))
        raise MessageError(f"{name} = {shown}: must be from {low:g} to {high:g}")
    return float(value)


def _shortened(text: str) -> str:
    return text if len(text) <= _SHOWN_DIGITS else f"{text[:_SHOWN_DIGITS]}…"
