"""What a page may ask of a running world: JSON objects with a `kind`, checked before they count."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

from cavmarl.core.errors import MessageError

MAX_TEXT = 4096
MAX_PACE = 1000.0
# Kinds that change the world or its clock; the others only change what the page itself is told.
CONTROLS = frozenset(
    {"pause", "play", "step", "pace", "reset", "seat", "drive", "seek", "insert", "close", "open"}
)
MAX_PLACE_M = 1e7


@dataclass(frozen=True)
class PageRequest:
    """One wish of a page.

    Attributes:
        kind: `watch` a vehicle, mark the `ghosts` of a zone; of `CONTROLS`: `pause`, `play`,
            `step`, `pace`, `reset`, take a `seat` and `drive` in it, `seek` a tick of a recording,
            `insert` a vehicle at a place, `close` the road there, or `open` it again.
        number: the vehicle, zone, agent or tick, None for none; seconds of the world in one of ours
            as `pace`, 0 for as fast as it can.
        x: of the place, m from the map's origin.
        y: likewise.
        sensors: whether to tell what the sensors of a vehicle see that is watched.
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
    """A JSON object of a page.

    Raises MessageError: it is none, or too long.
    """
    if len(text) > MAX_TEXT:
        raise MessageError(f"a request of {len(text)} characters: at most {MAX_TEXT} are taken")
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise MessageError("a request that is no JSON") from error
    if not isinstance(found, dict):
        raise MessageError(f"a request that is a {type(found).__name__}, no object")
    return found


def read_request(text: str) -> PageRequest:
    """What a page asks for.

    Raises MessageError: it is not understood.
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
    raise MessageError(f"a request of the kind {str(kind)[:40]!r}: there is none of that kind")


def _whole(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**53:
        raise MessageError(f"{name}: must be a whole number from 0, or null")
    return value


def _within(name: str, value: Any, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise MessageError(f"{name}: must be a number")
    if not (math.isfinite(value) and low <= value <= high):
        raise MessageError(f"{name} = {value:g}: must be from {low:g} to {high:g}")
    return float(value)
