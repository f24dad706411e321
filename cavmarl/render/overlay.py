"""Overlays of a picture: agent numbers, destinations, clock, scale bar and legend."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cavmarl.render.canvas import (
    INK,
    MUTED_INK,
    PANEL,
    agent_color,
    blank,
    ink_on,
    lettering,
    load_pygame,
    pill,
    stamp,
    target,
)
from cavmarl.render.viewport import Viewport

if TYPE_CHECKING:
    from pygame import Surface

from collections.abc import Callable
from typing import NamedTuple

from cavmarl.render.canvas import (
    ACTOR,
    BACKGROUND_CAR,
    COLLIDED,
    Color,
    Part,
    bar,
    opaque,
    ring,
    zone_color,
)

SWATCH_PX = 16
_HEIGHT_PX = 10.0


class Sample(NamedTuple):
    """An entry of the legend."""

    text: str  # label
    # draws the symbol, `SWATCH_PX` wide, given its left end and vertical centre
    draw: Callable[[float, float], list[Part]]


def samples_of_drivers(*, destinations: bool, actors: bool = False) -> list[Sample]:
    """Return the legend of a picture in which agents have their own colours.

    `destinations`: whether destinations of agents are shown. `actors`: whether there are scripted
    vehicles.
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
    """Return the legend of a picture in which vehicles have the colours of their zones.

    `ghosts_of`: the zone whose ghosts are outlined, if any.
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


MARGIN_PX = 14
PADDING_PX = 9
PANEL_ALPHA = 225
TITLE_PX = 23
TEXT_PX = 17
LABEL_PX = 15
SCALE_OF_LABELS_ON_CARS = 8.0  # scale in pixels per metre from which a car is wider than its number
SCALE_BAR_PX = 140


def clock_text(seconds: float) -> str:
    tenths = round(seconds * 10)
    return f"{tenths // 600}:{tenths // 10 % 60:02d}.{tenths % 10}"


def scale_bar_m(scale: float) -> float:
    """Return the longest 1, 2 or 5 times a power of ten metres that fits the scale bar."""
    room = SCALE_BAR_PX / scale
    power = 10.0 ** math.floor(math.log10(room))
    return power * max(step for step in (1, 2, 5) if step * power <= room)


class Overlay:
    """Draws overlays on pictures; caches the agents' labels."""

    def __init__(self) -> None:
        self._labels: dict[int, Surface] = {}

    def agents(self, surface: Surface, vehicles: NDArray[np.void], camera: Viewport) -> None:
        """Draw the agents' numbers: above their vehicles, or on them in close-ups."""
        rows = vehicles[vehicles["agent"] >= 0]
        centers = camera.to_pixels(np.stack([rows["x"], rows["y"]], axis=1))
        for agent, center in zip(rows["agent"].tolist(), centers.tolist(), strict=True):
            label = self._label(agent)
            lift = max(1.4 * camera.scale, 5.0) + label.get_height() * 0.75
            if camera.scale >= SCALE_OF_LABELS_ON_CARS:
                lift = 0.0
            surface.blit(label, label.get_rect(center=(center[0], center[1] - lift)))

    def destinations(
        self,
        surface: Surface,
        agents: NDArray[np.int64],
        places: NDArray[np.float64],
        camera: Viewport,
    ) -> None:
        """Draw a ring in the agent's colour at each destination, (n, 2) metres."""
        for agent, (x, y) in zip(agents.tolist(), camera.to_pixels(places).tolist(), strict=True):
            stamp(surface, target(x, y, agent_color(agent)))

    def title(self, surface: Surface, title: str, note: str) -> None:
        """Draw a panel at the upper left with a title and, below it, a less prominent note."""
        lines = [lettering(title, TITLE_PX, INK)] if title else []
        if note:
            lines.append(lettering(note, TEXT_PX, MUTED_INK))
        if not lines:
            return
        width = max(line.get_width() for line in lines)
        height = sum(line.get_height() for line in lines) + 5 * (len(lines) - 1)
        self._panel(surface, MARGIN_PX, MARGIN_PX, width, height)
        top = MARGIN_PX + PADDING_PX
        for line in lines:
            surface.blit(line, (MARGIN_PX + PADDING_PX, top))
            top += line.get_height() + 5

    def scale_bar(self, surface: Surface, camera: Viewport) -> None:
        """Draw a scale bar of round length at the lower left."""
        pygame = load_pygame()
        length_m = scale_bar_m(camera.scale)
        length_px = round(length_m * camera.scale)
        text = lettering(f"{length_m:g} m", TEXT_PX, INK)
        height = text.get_height() + 8
        top = surface.get_height() - MARGIN_PX - height - 2 * PADDING_PX
        self._panel(surface, MARGIN_PX, top, max(length_px, text.get_width()), height)
        left, bottom = MARGIN_PX + PADDING_PX, top + PADDING_PX + height
        surface.blit(text, (left, top + PADDING_PX))
        pygame.draw.rect(surface, INK, (left, bottom - 2, length_px, 2))
        for x in (left, left + length_px - 2):
            pygame.draw.rect(surface, INK, (x, bottom - 6, 2, 6))

    def legend(self, surface: Surface, samples: Sequence[Sample]) -> None:
        """Draw the legend at the lower right."""
        texts = [lettering(sample.text, TEXT_PX, INK) for sample in samples]
        width = sum(SWATCH_PX + 6 + text.get_width() for text in texts) + 12 * (len(texts) - 1)
        height = texts[0].get_height()
        left = surface.get_width() - MARGIN_PX - 2 * PADDING_PX - width
        top = surface.get_height() - MARGIN_PX - 2 * PADDING_PX - height
        self._panel(surface, left, top, width, height)
        x, middle = float(left + PADDING_PX), top + PADDING_PX + height / 2
        for sample, text in zip(samples, texts, strict=True):
            stamp(surface, sample.draw(x, middle))
            x += SWATCH_PX + 6
            surface.blit(text, (x, top + PADDING_PX))
            x += text.get_width() + 12

    def _label(self, agent: int) -> Surface:
        if agent not in self._labels:
            text = lettering(str(agent), TEXT_PX, ink_on(agent_color(agent)))
            width, height = max(text.get_width() + 9, LABEL_PX), LABEL_PX
            label = blank((width + 2, height + 2), transparent=True)
            stamp(label, [((255, 255, 255, 255), pill(0.0, 0.0, width + 2, height + 2))])
            stamp(label, [((*agent_color(agent), 255), pill(1.0, 1.0, width, height))])
            label.blit(text, text.get_rect(center=(width / 2 + 1, height / 2 + 1.5)))
            self._labels[agent] = label
        return self._labels[agent]

    def _panel(self, surface: Surface, left: int, top: int, width: int, height: int) -> None:
        pygame = load_pygame()
        size = (width + 2 * PADDING_PX, height + 2 * PADDING_PX)
        panel = blank(size, transparent=True)
        pygame.draw.rect(panel, (*PANEL, PANEL_ALPHA), panel.get_rect(), border_radius=7)
        surface.blit(panel, (left, top))
