"""The static part of a picture: land, buildings, roads and markings.

This module also draws the stop lines, in the colours of their signals.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import SIGNAL_NONE
from cavmarl.render.canvas import (
    ASPHALT,
    BUILDING,
    CENTRE_LINE,
    KERB,
    LAND,
    MARKING,
    PATH,
    SIGNALS,
    Color,
    blank,
    load_pygame,
    stamp,
)
from cavmarl.render.shapes import RoadShapes, level_of
from cavmarl.render.viewport import Viewport

if TYPE_CHECKING:
    from pygame import Surface

KERB_M = 0.6
# Smallest scales, in pixels per metre, at which markings and arrows are drawn.
SCALE_OF_MARKINGS = 0.9
SCALE_OF_ARROWS = 2.5
MARKING_M = 0.2
SEAM_PX = 0.25  # overlap of lanes, so that no land shows between them
MIN_ROAD_PX = 1.6
MIN_STOP_LINE_PX = 4.0


def draw_ground(shapes: RoadShapes, camera: Viewport, detail: int) -> Surface:
    """Draw land, buildings, roads and markings as seen by `camera`.

    `shapes`: shapes of the network. `detail`: factor by which the picture is drawn larger and then
    reduced, for smooth edges.
    """
    pygame = load_pygame()
    large = camera.enlarged(detail)
    surface = blank(large.size)
    surface.fill(LAND)
    painter = _Painter(shapes, large, surface, detail)
    painter.polygons(shapes.roofs, BUILDING)
    for level in np.unique(shapes.levels):
        for cars in (False, True):
            painter.roads(level, cars, KERB_M, KERB)
            painter.roads(level, cars, 0.0, ASPHALT if cars else PATH)
        if camera.scale >= SCALE_OF_MARKINGS:
            painter.lines(level, shapes.dashes, MARKING)
            painter.lines(level, shapes.centre_lines, CENTRE_LINE)
        if camera.scale >= SCALE_OF_ARROWS:
            painter.polygons(on_level(shapes.arrows, level), MARKING)
    reduced: Surface = pygame.transform.smoothscale(surface, camera.size)
    return reduced


def draw_stop_lines(
    surface: Surface, shapes: RoadShapes, codes: NDArray[np.uint8], camera: Viewport
) -> None:
    """Draw the stop line of each link with a signal.

    `shapes`: shapes of the network. `codes`: (num_links,) from `signal_codes`.
    """
    links = np.flatnonzero(codes != SIGNAL_NONE)
    quads = camera.to_pixels(shapes.stop_lines[links])
    depth = np.hypot(*(quads[:, 3] - quads[:, 0]).T)[:, None]
    stretch = np.maximum(MIN_STOP_LINE_PX / depth, 1.0)
    quads[:, 2] = quads[:, 1] + (quads[:, 2] - quads[:, 1]) * stretch
    quads[:, 3] = quads[:, 0] + (quads[:, 3] - quads[:, 0]) * stretch
    for link, quad in zip(links, quads.tolist(), strict=True):
        stamp(surface, [((*SIGNALS[codes[link]], 255), quad)])


def on_level(corners: NDArray[np.float64], level: int) -> NDArray[np.float64]:
    """Return the shapes (k, n, 3) that begin on a level."""
    return np.asarray(corners[level_of(corners[:, 0, 2]) == level])


class _Painter:
    """Draws many shapes of a kind on one surface, skipping those out of view."""

    def __init__(self, shapes: RoadShapes, camera: Viewport, surface: Surface, detail: int) -> None:
        self._pygame = load_pygame()
        self._shapes = shapes
        self._camera = camera
        self._surface = surface
        self._detail = detail
        self._min_half_px = MIN_ROAD_PX * detail / 2.0
        low = np.minimum(shapes.starts, shapes.ends) - shapes.half_widths[:, None]
        high = np.maximum(shapes.starts, shapes.ends) + shapes.half_widths[:, None]
        self._in_view = self._visible(low, high)
        boxes = shapes.junction_boxes
        patches = np.flatnonzero(self._visible(boxes[:, 0], boxes[:, 1]))
        self._patches = [shapes.junctions[patch] for patch in patches]

    def roads(self, level: int, cars: bool, grown_m: float, color: Color) -> None:
        """Draw the lanes and junction interiors of one level, wider by `grown_m` on each side."""
        shapes, scale = self._shapes, self._camera.scale
        grown_px = grown_m * scale
        if grown_m:
            grown_px = max(grown_px, self._min_half_px)
        chosen = np.flatnonzero(
            self._in_view & (shapes.levels == level) & (shapes.for_cars == cars)
        )
        half_px = np.maximum(shapes.half_widths[chosen] * scale, self._min_half_px) + grown_px
        half_px += SEAM_PX * self._detail
        starts = self._camera.to_pixels(shapes.starts[chosen])
        ends = self._camera.to_pixels(shapes.ends[chosen])
        self._bars(starts, ends, half_px, color)
        joined = shapes.joined[chosen] & (half_px >= 1.0)
        circle = self._pygame.draw.circle
        for center, radius in zip(ends[joined].tolist(), half_px[joined].tolist(), strict=True):
            circle(self._surface, color, center, radius)
        for patch in self._patches:
            if patch.level == level and patch.for_cars == cars:
                self._patch(patch.outline, grown_px, color)

    def lines(self, level: int, pieces: NDArray[np.float64], color: Color) -> None:
        """Draw straight lines (k, 2, 3) on asphalt; lines thinner than a pixel are drawn paler."""
        pixels = self._camera.to_pixels(self._in_sight(on_level(pieces, level)))
        width_px = MARKING_M * self._camera.scale / self._detail
        share = min(max(width_px, 0.3), 1.0)
        ink = tuple(
            round(share * c + (1.0 - share) * a) for c, a in zip(color, ASPHALT, strict=True)
        )
        half_px = np.full(len(pixels), max(width_px, 1.0) * self._detail / 2.0)
        self._bars(pixels[:, 0], pixels[:, 1], half_px, (ink[0], ink[1], ink[2]))

    def polygons(self, corners: NDArray[np.float64], color: Color) -> None:
        """Draw polygons (k, n, 2 or more)."""
        for polygon in self._camera.to_pixels(self._in_sight(corners)).tolist():
            self._pygame.draw.polygon(self._surface, color, polygon)

    def _in_sight(self, corners: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(corners[self._visible(corners.min(axis=1), corners.max(axis=1))])

    def _visible(self, low: NDArray[Any], high: NDArray[Any]) -> NDArray[np.bool_]:
        min_x, min_y, max_x, max_y = self._camera.bounds
        return np.asarray(
            (high[:, 0] > min_x) & (low[:, 0] < max_x) & (high[:, 1] > min_y) & (low[:, 1] < max_y)
        )

    def _bars(
        self,
        starts: NDArray[np.float64],
        ends: NDArray[np.float64],
        half_px: NDArray[np.float64],
        color: Color,
    ) -> None:
        along = ends - starts
        length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)
        aside = np.stack([-along[:, 1], along[:, 0]], axis=1) * (half_px / length)[:, None]
        quads = np.stack([starts + aside, ends + aside, ends - aside, starts - aside], axis=1)
        polygon = self._pygame.draw.polygon
        for quad in quads.tolist():
            polygon(self._surface, color, quad)

    def _patch(self, outline: NDArray[np.float64], grown_px: float, color: Color) -> None:
        corners = self._camera.to_pixels(outline)
        self._pygame.draw.polygon(self._surface, color, corners.tolist())
        if grown_px >= 1.0:
            after = np.roll(corners, -1, axis=0)
            self._bars(corners, after, np.full(len(corners), grown_px), color)
            for corner in corners.tolist():
                self._pygame.draw.circle(self._surface, color, corner, grown_px)
