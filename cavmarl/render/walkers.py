"""Pedestrians, seen from above: shoulders and a head."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from cavmarl.core.records.codes import DRIVER_SCRIPTED, EVENT_COLLIDED
from cavmarl.render.canvas import Part, stamp
from cavmarl.render.marks import opaque
from cavmarl.render.palette import ACTOR, COLLIDED, INK, PANEL

if TYPE_CHECKING:
    from pygame import Surface

WALKER_M = 1.0  # no vehicle of a script is so short
MIN_RADIUS_PX = 4.5
CORNERS = 12
DEPTH = 0.6  # of the shoulders, in parts of their width
HEAD = 0.5
RIM_PX = 1.0
COLLIDED_PX = 2.5


def is_walker(row: np.void) -> bool:
    """Whether a VEHICLE row is a pedestrian."""
    return bool(row["driver"] == DRIVER_SCRIPTED and row["length"] < WALKER_M)


def draw_walker(surface: Surface, row: np.void, center: list[float], scale: float) -> None:
    """Paint a pedestrian, from far above larger than one is.

    `scale`: pixels a metre.
    """
    half = max(0.5 * float(row["width"]) * scale, MIN_RADIUS_PX)
    heading = float(row["heading"])

    def oval(depth: float, width: float) -> list[tuple[float, float]]:
        corners = []
        for k in range(CORNERS):
            angle = 2.0 * math.pi * k / CORNERS
            ahead, aside = depth * math.cos(angle), width * math.sin(angle)
            corners.append(
                (
                    center[0] + ahead * math.cos(heading) - aside * math.sin(heading),
                    center[1] - ahead * math.sin(heading) - aside * math.cos(heading),
                )
            )
        return corners

    hurt = row["hit"] >= 0 or row["events"] & EVENT_COLLIDED
    rim, rim_px = (COLLIDED, COLLIDED_PX) if hurt else (PANEL, RIM_PX)
    parts: list[Part] = [
        (opaque(rim), oval(DEPTH * half + rim_px, half + rim_px)),
        (opaque(ACTOR), oval(DEPTH * half, half)),
        (opaque(INK), oval(HEAD * half, HEAD * half)),
    ]
    stamp(surface, parts)
