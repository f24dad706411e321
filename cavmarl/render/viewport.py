"""`Viewport`: the part of the plane that a picture shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Bounds = tuple[float, float, float, float]  # min_x, min_y, max_x, max_y in metres

# Default size of a picture in pixels, and limits of its aspect ratio.
PICTURE_PX = 960 * 720
MIN_ASPECT = 1.25
MAX_ASPECT = 3.0


@dataclass(frozen=True)
class Viewport:
    """A view from straight above, north up, with equal scales of both axes."""

    x: float  # centre of the picture, m
    y: float  # centre of the picture, m
    scale: float  # pixels per metre
    size: tuple[int, int]  # width and height in pixels

    @classmethod
    def fit(cls, bounds: Bounds, size: tuple[int, int], margin_px: float = 0.0) -> Viewport:
        """Return the closest view of `bounds`, with a margin of at most a quarter at each side."""
        min_x, min_y, max_x, max_y = bounds
        width, height = (max(side - 2.0 * margin_px, side / 2.0) for side in size)
        scale = min(width / max(max_x - min_x, 1.0), height / max(max_y - min_y, 1.0))
        return cls((min_x + max_x) / 2.0, (min_y + max_y) / 2.0, scale, size)

    @property
    def bounds(self) -> Bounds:
        """The visible area, m."""
        half_width = self.size[0] / 2.0 / self.scale
        half_height = self.size[1] / 2.0 / self.scale
        return (
            self.x - half_width,
            self.y - half_height,
            self.x + half_width,
            self.y + half_height,
        )

    def to_pixels(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert metres (…, 2 or 3) to pixels (…, 2) from the upper left corner."""
        pixels = np.empty((*xy.shape[:-1], 2))
        pixels[..., 0] = (xy[..., 0] - self.x) * self.scale + self.size[0] / 2.0
        pixels[..., 1] = (self.y - xy[..., 1]) * self.scale + self.size[1] / 2.0
        return pixels

    def enlarged(self, factor: int) -> Viewport:
        """Return the same view with `factor` times as many pixels in each direction."""
        return Viewport(
            self.x, self.y, self.scale * factor, (self.size[0] * factor, self.size[1] * factor)
        )

    def towards(self, target: Viewport, share: float) -> Viewport:
        """Return a view moved by `share` towards `target`; the scale changes geometrically."""
        return Viewport(
            self.x + share * (target.x - self.x),
            self.y + share * (target.y - self.y),
            self.scale * (target.scale / self.scale) ** share,
            target.size,
        )


def suitable_size(bounds: Bounds) -> tuple[int, int]:
    """Return a size with the proportions of `bounds`, in steps of 16 pixels for video encoders."""
    min_x, min_y, max_x, max_y = bounds
    aspect = max(max_x - min_x, 1.0) / max(max_y - min_y, 1.0)
    aspect = min(max(aspect, MIN_ASPECT), MAX_ASPECT)
    width, height = (PICTURE_PX * aspect) ** 0.5, (PICTURE_PX / aspect) ** 0.5
    return round(width / 16) * 16, round(height / 16) * 16
