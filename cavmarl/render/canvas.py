"""The colours of all pictures, and smooth polygons drawn with pygame, which is loaded at first use.

Colours are (red, green, blue). The map has muted colours, so that agents stand out.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from functools import lru_cache
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import require

if TYPE_CHECKING:
    from pygame import Font, Surface


Color = tuple[int, int, int]

LAND: Color = (235, 237, 230)
BUILDING: Color = (216, 213, 206)
KERB: Color = (205, 208, 200)
ASPHALT: Color = (98, 107, 119)
PATH: Color = (212, 211, 203)  # lanes closed to cars
MARKING: Color = (214, 219, 224)
CENTRE_LINE: Color = (226, 206, 150)

BACKGROUND_CAR: Color = (186, 204, 225)
ACTOR: Color = (250, 232, 120)  # scripted vehicle
GLASS: Color = (48, 58, 72)
HEADLIGHT: Color = (255, 250, 225)
BRAKE: Color = (255, 56, 48)
BLINKER: Color = (255, 178, 36)
COLLIDED: Color = (222, 22, 34)

# Hues alternate, so that agents with neighbouring numbers differ most.
AGENTS: tuple[Color, ...] = (
    (255, 127, 14),
    (30, 144, 255),
    (236, 64, 122),
    (46, 184, 92),
    (255, 202, 40),
    (149, 97, 226),
    (0, 188, 212),
    (244, 81, 60),
    (156, 204, 40),
    (205, 92, 190),
)

# Colours of zones and of their vehicles; adjacent zones rarely share one. The palette is that of M.
# Okabe and K. Ito, Color Universal Design (2008), which is distinguishable with any colour vision.
ZONES: tuple[Color, ...] = (
    (0, 114, 178),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (213, 94, 0),
    (86, 180, 233),
    (240, 228, 66),
)

# By signal code, the index in roads.network.SIGNAL_STATES = "rugGysoOY".
SIGNALS: tuple[Color, ...] = (
    (232, 58, 52),
    (245, 132, 42),
    (88, 196, 116),
    (38, 208, 98),
    (250, 204, 56),
    (150, 110, 220),
    (224, 190, 120),
    (170, 176, 182),
    (250, 204, 56),
)

PANEL: Color = (252, 252, 250)
INK: Color = (44, 52, 62)
MUTED_INK: Color = (112, 120, 130)


def agent_color(agent: int) -> Color:
    return AGENTS[agent % len(AGENTS)]


def zone_color(zone: int) -> Color:
    return ZONES[zone % len(ZONES)]


def ink_on(color: Color) -> Color:
    """Return the dark or the light ink, whichever has more contrast (luma of ITU-R BT.601)."""
    luma = 0.299 * color[0] + 0.587 * color[1] + 0.114 * color[2]
    return INK if luma > 140 else PANEL


Part = tuple[Sequence[int], Sequence[Sequence[float]]]  # colour with alpha, corners in pixels

# Stamps are drawn at this multiple of their size, then reduced, for subpixel edges.
STAMP_DETAIL = 4
# Text is also drawn large and reduced, because small letters would be spaced unevenly.
TEXT_DETAIL = 4
_QUIET = "PYGAME_HIDE_SUPPORT_PROMPT"


def load_pygame() -> ModuleType:
    """Import pygame without its greeting; no window opens, and the process environment is kept.

    Raises MissingExtraError: pygame-ce is not installed.
    """
    before = os.environ.get(_QUIET)
    os.environ[_QUIET] = "1"
    try:
        return require("pygame", "render")
    finally:
        if before is None:
            del os.environ[_QUIET]
        else:
            os.environ[_QUIET] = before


@lru_cache(maxsize=256)
def lettering(text: str, height_px: int, color: tuple[int, int, int]) -> Surface:
    """Render text in pygame's own font, which is the same everywhere, without a background."""
    pygame = load_pygame()
    large = _font(height_px * TEXT_DETAIL).render(text, True, color)
    size = (math.ceil(large.get_width() / TEXT_DETAIL), math.ceil(large.get_height() / TEXT_DETAIL))
    reduced: Surface = pygame.transform.smoothscale(large, size)
    return reduced


@lru_cache
def _font(height_px: int) -> Font:
    pygame = load_pygame()
    pygame.font.init()
    font: Font = pygame.font.Font(None, height_px)
    return font


def blank(size: tuple[int, int], *, transparent: bool = False) -> Surface:
    """Return an off-screen surface of 32 bits; no display is needed."""
    pygame = load_pygame()
    flags = pygame.SRCALPHA if transparent else 0
    surface: Surface = pygame.Surface(size, flags, 32)
    return surface


def pixels(surface: Surface) -> NDArray[np.uint8]:
    """Return a surface's pixels as uint8 (height, width, 3) in red, green, blue."""
    data = load_pygame().image.tobytes(surface, "RGB")
    width, height = surface.get_size()
    return np.frombuffer(data, dtype=np.uint8).reshape(height, width, 3).copy()


def stamp(target: Surface, parts: Sequence[Part]) -> None:
    """Draw polygons one over another, with smooth edges.

    `parts`: colours (red, green, blue, alpha; premultiplied by alpha), and corners in pixels of
    `target`, which may be fractional.
    """
    pygame = load_pygame()
    corners = [corner for _, polygon in parts for corner in polygon]
    left = math.floor(min(corner[0] for corner in corners)) - 1
    top = math.floor(min(corner[1] for corner in corners)) - 1
    width = math.ceil(max(corner[0] for corner in corners)) + 1 - left
    height = math.ceil(max(corner[1] for corner in corners)) + 1 - top
    if not target.get_rect().colliderect((left, top, width, height)):
        return
    if width * height > target.get_width() * target.get_height():  # a body larger than the picture
        left, top, width, height = target.get_rect().clip((left, top, width, height))
    large = blank((width * STAMP_DETAIL, height * STAMP_DETAIL), transparent=True)
    for color, polygon in parts:
        pygame.draw.polygon(
            large,
            color,
            [((x - left) * STAMP_DETAIL, (y - top) * STAMP_DETAIL) for x, y in polygon],
        )
    # The average of premultiplied colours is premultiplied too, so edges have no dark seams.
    small = pygame.transform.smoothscale(large, (width, height))
    target.blit(small, (left, top), special_flags=pygame.BLEND_PREMULTIPLIED)


Corner = tuple[float, float]
_SIDES = 32
_WHITE = (255, 255, 255, 255)
_SHADOW = (0, 0, 0, 50)

RING_WIDTH_PX = 3.0
CASING_PX = 1.3  # width of dark edges, which show on any background
HEAD_PX = 12.0  # length of an arrow head, from the ring to the tip


def opaque(color: Color) -> tuple[int, int, int, int]:
    return (*color, 255)


def disc(x: float, y: float, radius: float) -> list[Corner]:
    return [
        (x + radius * math.cos(angle), y + radius * math.sin(angle))
        for angle in (2.0 * math.pi * k / _SIDES for k in range(_SIDES))
    ]


def bar(x: float, y: float, width: float, height: float) -> list[Corner]:
    """Return a rectangle with its upper left corner at (x, y)."""
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
    """Return a ring with dark edges that leaves its inside uncovered."""
    return [
        (opaque(INK), _annulus(x, y, radius - CASING_PX, radius + RING_WIDTH_PX + CASING_PX)),
        (opaque(color), _annulus(x, y, radius, radius + RING_WIDTH_PX)),
    ]


def pointer(
    x: float, y: float, radius: float, direction: tuple[float, float], color: Color
) -> list[Part]:
    """Return a ring with an arrow head pointing away; `direction` is a unit vector, y down."""
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
    """Return a ring as one polygon: around the outside and back inside, with a seam of no width."""
    there, back = disc(x, y, outer), disc(x, y, inner)
    return [*there, there[0], back[0], *reversed(back)]
