"""What stands in the legend: a small sample and a word for each thing that a picture shows."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from cavmarl.render.canvas import Part
from cavmarl.render.marks import bar, opaque, ring, target
from cavmarl.render.palette import (
    ACTOR,
    BACKGROUND_CAR,
    COLLIDED,
    INK,
    Color,
    agent_color,
    zone_color,
)

SWATCH_PX = 16
_HEIGHT_PX = 10.0


class Sample(NamedTuple):
    """An entry of the legend."""

    text: str  # what it says
    # its sample, `SWATCH_PX` wide, from the left end and the middle of its height
    draw: Callable[[float, float], list[Part]]


def samples_of_drivers(*, destinations: bool, actors: bool = False) -> list[Sample]:
    """Of a picture in which agents have colours of their own.

    `destinations`: whether those of agents are shown. `actors`: whether any follows a script.
    """
    samples = [Sample("agents", lambda x, y: _stripes([agent_color(k) for k in range(4)], x, y))]
    if destinations:
        samples.append(
            Sample("destination", lambda x, y: target(x + SWATCH_PX / 2.0, y, agent_color(0)))
        )
    if actors:
        samples.append(Sample("script", lambda x, y: _stripes([ACTOR], x, y)))
    samples.append(Sample("background", lambda x, y: _stripes([BACKGROUND_CAR], x, y)))
    samples.append(Sample("collided", lambda x, y: _nested([COLLIDED, BACKGROUND_CAR], x, y)))
    return samples


def samples_of_zones(count: int, ghosts_of: int | None) -> list[Sample]:
    """Of a picture in which vehicles have the colours of their zones.

    `ghosts_of`: the zone whose ghosts are outlined, if one is.
    """
    owners = [zone_color(zone) for zone in range(min(count, 4))]
    samples = [Sample("vehicles by owner", lambda x, y: _stripes(owners, x, y))]
    if ghosts_of is not None:
        ghost = [INK, zone_color(ghosts_of), zone_color(ghosts_of + 1)]
        samples.append(Sample(f"ghost in zone {ghosts_of}", lambda x, y: _nested(ghost, x, y)))
    middle = SWATCH_PX / 2.0
    samples.append(Sample("transfer", lambda x, y: ring(x + middle, y, 4.0, owners[-1])))
    samples.append(Sample("collided", lambda x, y: _nested([COLLIDED, owners[0]], x, y)))
    return samples


def _stripes(colors: list[Color], x: float, y: float) -> list[Part]:
    width, top = SWATCH_PX / len(colors), y - _HEIGHT_PX / 2.0
    return [
        (opaque(color), bar(x + k * width, top, width, _HEIGHT_PX))
        for k, color in enumerate(colors)
    ]


def _nested(colors: list[Color], x: float, y: float) -> list[Part]:
    parts: list[Part] = []
    for k, color in enumerate(colors):
        inset = 2.0 * k
        box = bar(
            x + inset, y - _HEIGHT_PX / 2.0 + inset, SWATCH_PX - 2 * inset, _HEIGHT_PX - 2 * inset
        )
        parts.append((opaque(color), box))
    return parts
