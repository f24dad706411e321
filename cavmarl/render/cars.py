"""Vehicles and pedestrians, seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import DRIVER_SCRIPTED, EVENT_COLLIDED
from cavmarl.render.canvas import (
    ACTOR,
    BACKGROUND_CAR,
    BLINKER,
    BRAKE,
    COLLIDED,
    GLASS,
    HEADLIGHT,
    Color,
    Part,
    agent_color,
    opaque,
    stamp,
)
from cavmarl.render.viewport import Viewport

if TYPE_CHECKING:
    from pygame import Surface

import math
from typing import TYPE_CHECKING

from cavmarl.render.canvas import INK, PANEL

if TYPE_CHECKING:
    from pygame import Surface

WALKER_M = 1.0  # shorter scripted road users are pedestrians
MIN_RADIUS_PX = 4.5
CORNERS = 12  # of the polygon of an oval
DEPTH = 0.6  # depth of a pedestrian's shoulders, as a share of their width
HEAD = 0.5  # diameter of a pedestrian's head, as a share of the width of the shoulders
RIM_PX = 1.0
COLLIDED_PX = 2.5


def is_walker(row: np.void) -> bool:
    return bool(row["driver"] == DRIVER_SCRIPTED and row["length"] < WALKER_M)


def draw_walker(surface: Surface, row: np.void, center: list[float], scale: float) -> None:
    """Draw a pedestrian, enlarged at small scales.

    `scale`: pixels per metre.
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


BRAKING_MPS2 = -1.0  # the brake lights are on below this acceleration

# Smallest size at which a car is drawn.
MIN_LENGTH_PX = 8.0
MIN_WIDTH_PX = 3.8
AGENT_MIN_LENGTH_PX = 13.0
AGENT_MIN_WIDTH_PX = 6.4
WIDTH_OF_DETAILS_PX = 5.0
OUTLINE_PX = 1.6

# Polygons of a car with half length 1 and half width 1; the nose is at x = 1, left is positive y.
LEFT_SIDE = ((1.0, 0.5), (0.86, 0.92), (0.6, 1.0), (-0.88, 1.0), (-1.0, 0.8))
BODY = (*LEFT_SIDE, *((x, -y) for x, y in reversed(LEFT_SIDE)))
WINDSCREEN = ((0.42, 0.62), (0.42, -0.62), (0.12, -0.78), (0.12, 0.78))
REAR_WINDOW = ((-0.58, 0.74), (-0.58, -0.74), (-0.78, -0.6), (-0.78, 0.6))
RIGHT_HEADLIGHT = ((0.98, -0.5), (0.86, -0.9), (0.78, -0.82), (0.88, -0.46))
RIGHT_REAR_LIGHT = ((-1.02, -0.36), (-1.02, -0.86), (-0.86, -0.96), (-0.86, -0.36))
RIGHT_FRONT_BLINKER = ((0.92, -0.72), (0.84, -1.06), (0.62, -1.06), (0.66, -0.78))
RIGHT_REAR_BLINKER = ((-1.0, -0.7), (-1.0, -1.06), (-0.72, -1.06), (-0.72, -0.76))
REAR_BAR = ((-1.04, 0.86), (-1.04, -0.86), (-0.66, -0.86), (-0.66, 0.86))

Shape = tuple[tuple[float, float], ...]


def in_view(vehicles: NDArray[np.void], camera: Viewport) -> NDArray[np.void]:
    """Return the visible VEHICLE rows in drawing order: background first, then by height."""
    min_x, min_y, max_x, max_y = camera.bounds
    margin = max(float(vehicles["length"].max(initial=0.0)), MIN_LENGTH_PX / camera.scale)
    seen = vehicles[
        (vehicles["x"] > min_x - margin)
        & (vehicles["x"] < max_x + margin)
        & (vehicles["y"] > min_y - margin)
        & (vehicles["y"] < max_y + margin)
    ]
    return seen[np.lexsort((seen["id"], seen["z"], seen["agent"] >= 0))]


class Paint(NamedTuple):
    """The paint of a car."""

    body: Color  # colour of the body
    rims: tuple[Color, ...] = ()  # colours of rims around the body, outermost first
    lined: bool = False  # whether the body has a thin light outline


def draw_cars(
    surface: Surface,
    vehicles: NDArray[np.void],
    camera: Viewport,
    paints: Sequence[Paint] | None = None,
) -> None:
    """Draw VEHICLE rows, later rows over earlier ones.

    Brake lights are on below `BRAKING_MPS2`; a red outline marks a collided vehicle.

    `paints`: paint of each row; by default, agents have the colours of `agent_color`.
    """
    if paints is None:
        paints = [_paint_of_driver(row) for row in vehicles]
    centers = camera.to_pixels(np.stack([vehicles["x"], vehicles["y"]], axis=1)).tolist()
    for row, center, paint in zip(vehicles, centers, paints, strict=True):
        if is_walker(row):
            draw_walker(surface, row, center, camera.scale)
            continue
        _draw_car(surface, row, center, camera.scale, paint)


def _paint_of_driver(row: np.void) -> Paint:
    if row["agent"] >= 0:
        return Paint(agent_color(int(row["agent"])), lined=True)
    return Paint(ACTOR if row["driver"] == DRIVER_SCRIPTED else BACKGROUND_CAR)


def _draw_car(
    surface: Surface, row: np.void, center: list[float], scale: float, paint: Paint
) -> None:
    is_agent = row["agent"] >= 0
    half_length = max(row["length"] * scale, AGENT_MIN_LENGTH_PX if is_agent else MIN_LENGTH_PX) / 2
    half_width = max(row["width"] * scale, AGENT_MIN_WIDTH_PX if is_agent else MIN_WIDTH_PX) / 2
    heading = float(row["heading"])
    # The columns of the rotation matrix, with y down.
    forward = np.cos(heading), -np.sin(heading)
    left = -np.sin(heading), -np.cos(heading)

    def place(
        shape: Shape, grown_px: float = 0.0, moved_px: float = 0.0
    ) -> list[tuple[float, float]]:
        ahead, aside = half_length + grown_px, half_width + grown_px
        return [
            (
                center[0] + moved_px + x * ahead * forward[0] + y * aside * left[0],
                center[1] + moved_px + x * ahead * forward[1] + y * aside * left[1],
            )
            for x, y in shape
        ]

    parts: list[Part] = [((0, 0, 0, 46), place(BODY, 0.3, half_width * 0.22))]
    for n, rim in enumerate(paint.rims):
        parts.append((opaque(rim), place(BODY, OUTLINE_PX * (len(paint.rims) - n + 1))))
    if row["hit"] >= 0 or row["events"] & EVENT_COLLIDED:
        parts.append((opaque(COLLIDED), place(BODY, OUTLINE_PX + 1.0)))
    elif paint.lined:
        parts.append(((236, 236, 236, 236), place(BODY, OUTLINE_PX / 2)))
    parts.append((opaque(paint.body), place(BODY)))
    braking = row["accel"] < BRAKING_MPS2
    if 2 * half_width < WIDTH_OF_DETAILS_PX:
        if braking:
            parts.append((opaque(BRAKE), place(REAR_BAR)))
    else:
        parts += [(opaque(tint), place(shape)) for tint, shape in _details(row, braking)]
    stamp(surface, parts)


def _details(row: np.void, braking: bool) -> list[tuple[Color, Shape]]:
    details: list[tuple[Color, Shape]] = [(GLASS, WINDSCREEN), (GLASS, REAR_WINDOW)]
    details += [(HEADLIGHT, RIGHT_HEADLIGHT), (HEADLIGHT, _mirrored(RIGHT_HEADLIGHT))]
    if braking:
        details += [(BRAKE, RIGHT_REAR_LIGHT), (BRAKE, _mirrored(RIGHT_REAR_LIGHT))]
    if row["blinker"]:
        for shape in (RIGHT_FRONT_BLINKER, RIGHT_REAR_BLINKER):
            details.append((BLINKER, _mirrored(shape) if row["blinker"] > 0 else shape))
    return details


def _mirrored(shape: Shape) -> Shape:
    return tuple((x, -y) for x, y in shape)
