"""Small figures that stand for something: on the map and in the legend."""

from __future__ import annotations

import math

from cavmarl.render.canvas import Part
from cavmarl.render.palette import INK, Color

Corner = tuple[float, float]
_SIDES = 32
_WHITE = (255, 255, 255, 255)
_SHADOW = (0, 0, 0, 50)

RING_WIDTH_PX = 3.0
CASING_PX = 1.3  # dark edges, so that a figure shows on any ground
HEAD_PX = 12.0  # from the ring to the tip


def opaque(color: Color) -> tuple[int, int, int, int]:
    return (*color, 255)


def disc(x: float, y: float, radius: float) -> list[Corner]:
    return [
        (x + radius * math.cos(angle), y + radius * math.sin(angle))
        for angle in (2.0 * math.pi * k / _SIDES for k in range(_SIDES))
    ]


def bar(x: float, y: float, width: float, height: float) -> list[Corner]:
    """A rectangle with its upper left corner at (x, y)."""
    return [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]


def pill(x: float, y: float, width: float, height: float) -> list[Corner]:
    radius = height / 2.0
    turns = [math.pi * k / 12 for k in range(13)]
    right = [
        (x + width - radius + radius * math.sin(a), y + radius - radius * math.cos(a))
        for a in turns
    ]
    left = [(x + radius - radius * math.sin(a), y + radius + radius * math.cos(a)) for a in turns]
    return right + left


def target(x: float, y: float, color: Color) -> list[Part]:
    return [
        (_SHADOW, disc(x + 0.8, y + 0.8, 6.0)),
        (_WHITE, disc(x, y, 5.6)),
        (opaque(color), disc(x, y, 4.4)),
        (_WHITE, disc(x, y, 2.0)),
    ]


def ring(x: float, y: float, radius: float, color: Color) -> list[Part]:
    """A ring with dark edges that leaves what it surrounds uncovered."""
    return [
        (opaque(INK), _annulus(x, y, radius - CASING_PX, radius + RING_WIDTH_PX + CASING_PX)),
        (opaque(color), _annulus(x, y, radius, radius + RING_WIDTH_PX)),
    ]


def pointer(
    x: float, y: float, radius: float, direction: tuple[float, float], color: Color
) -> list[Part]:
    """A ring with a head that points away from it; `direction` has length 1, y down."""
    ahead, aside = direction, (-direction[1], direction[0])

    def head(grown: float) -> list[Corner]:
        base, tip = radius - grown, radius + HEAD_PX + 1.6 * grown
        half = 0.6 * HEAD_PX + 1.4 * grown
        return [
            (x + a * ahead[0] + b * aside[0], y + a * ahead[1] + b * aside[1])
            for a, b in ((tip, 0.0), (base, half), (base, -half))
        ]

    edge, inside = ring(x, y, radius, color)
    return [(opaque(INK), head(CASING_PX)), edge, (opaque(color), head(0.0)), inside]


def _annulus(x: float, y: float, inner: float, outer: float) -> list[Corner]:
    """Out around and back inside: one polygon, closed along a seam without width."""
    there, back = disc(x, y, outer), disc(x, y, inner)
    return [*there, there[0], back[0], *reversed(back)]
