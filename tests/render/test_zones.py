from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("pygame", reason="pictures need the extra 'render'")

from cavmarl.render.canvas import blank, load_pygame
from cavmarl.render.viewport import Viewport
from cavmarl.render.zone_overlay import draw_zones, zone_picture
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_layouts import cut_map
from tests.support.partitions import PINWHEEL


def pixels(surface: object) -> NDArray[np.uint8]:
    pygame = load_pygame()
    width, height = surface.get_size()  # type: ignore[attr-defined]
    data = pygame.image.tobytes(surface, "RGB")
    return np.frombuffer(data, np.uint8).reshape(height, width, 3)


def test_each_zone_has_a_colour_that_is_darker_in_the_halo() -> None:
    surface = blank((300, 300))
    surface.fill((255, 255, 255))
    draw_zones(surface, PINWHEEL, 2.0, Viewport.fit(PINWHEEL.bounds, (300, 300)))
    image = pixels(surface).astype(int)

    def at(x: float, y: float) -> list[int]:
        return list(image[int(299 - 10 * y), int(10 * x)])

    middle, halo, other = at(15.0, 13.0), at(15.0, 11.0), at(15.0, 5.5)
    assert len({tuple(middle), tuple(halo), tuple(other)}) == 3
    assert sum(halo) < sum(middle)
    # Zones at the edge of the map reach to infinity, so no halo is at the edge of the picture.
    assert at(3.0, 1.0) == at(3.0, 5.0)
    assert sum(at(3.0, 9.0)) < sum(at(3.0, 5.0))


def test_a_map_is_drawn_with_its_zones(grid: RoadNetwork) -> None:
    zones = cut_map(grid, "grid", 4)
    one = zone_picture(grid, cut_map(grid, "grid", 1), 50.0, "grid4x4")
    four = zone_picture(grid, zones, 50.0, "grid4x4")
    assert four.get_size() == one.get_size()
    assert (pixels(four) != pixels(one)).any(axis=2).mean() > 0.3
