"""Zones drawn over a map: tinted areas, halos, borders and numbers.

Vehicles show their owner, the zones that have them as ghosts, and transfers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cavmarl.render.canvas import INK, blank, ink_on, lettering, load_pygame, zone_color
from cavmarl.render.ground import draw_ground
from cavmarl.render.overlay import Overlay
from cavmarl.render.shapes import road_shapes
from cavmarl.render.viewport import Viewport, suitable_size
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_partition import ZonePartition

if TYPE_CHECKING:
    from pygame import Rect, Surface

from typing import TYPE_CHECKING

from cavmarl.handoff.zone_view import TransferInFlight, ZoneView
from cavmarl.render.canvas import pointer, stamp
from cavmarl.render.cars import Paint

if TYPE_CHECKING:
    from pygame import Surface

WASH_ALPHA = 20
HALO_ALPHA = 52
BORDER_PX = 2
SIGHT_PX = 4
NUMBER_PX = 26
NUMBER_PADDING_PX = 7
MARGIN_PX = 50.0
DETAIL = 4


def zone_picture(
    network: RoadNetwork, partition: ZonePartition, halo_m: float, title: str
) -> Surface:
    """Draw a map with its zones.

    `halo_m`: how far zones see over their borders; areas seen by another zone are darker. `title`:
    text for the upper left corner.

    Raises MissingExtraError: pygame-ce is not installed.
    """
    size = suitable_size(partition.bounds)
    camera = Viewport.fit(partition.bounds, size, MARGIN_PX)
    surface = draw_ground(road_shapes(network), camera, DETAIL)
    draw_zones(surface, partition, halo_m, camera)
    overlay = Overlay()
    overlay.title(surface, title, f"{partition.count} zones   halo {halo_m:g} m")
    overlay.scale_bar(surface, camera)
    return surface


def draw_zones(surface: Surface, partition: ZonePartition, halo_m: float, camera: Viewport) -> None:
    pygame = load_pygame()
    wash = blank(surface.get_size(), transparent=True)
    shown = _clipped(partition.reaching, camera)
    inner = partition.reaching + np.array([halo_m, halo_m, -halo_m, -halo_m])
    for zone, (outer, core) in enumerate(zip(shown, _clipped(inner, camera), strict=True)):
        color = zone_color(zone)
        pygame.draw.rect(wash, (*color, HALO_ALPHA), _pixels(outer, camera))
        if (core[:2] < core[2:]).all():
            pygame.draw.rect(wash, (*color, WASH_ALPHA), _pixels(core, camera))
    surface.blit(wash, (0, 0))
    for zone, outer in enumerate(shown):
        left, top, width, height = _pixels(outer, camera)
        pygame.draw.rect(
            surface, INK, (left - 1, top - 1, width + BORDER_PX, height + BORDER_PX), BORDER_PX
        )
        _number(surface, zone, pygame.Rect(left, top, width, height))


def draw_sight(
    surface: Surface, partition: ZonePartition, halo_m: float, zone: int, camera: Viewport
) -> None:
    """Draw the sensing range of a zone: the outer edge of its halo, in its colour."""
    pygame = load_pygame()
    seen = partition.reaching[[zone]] + np.array([-halo_m, -halo_m, halo_m, halo_m])
    # Far enough outside the view that round corners of clipped shapes stay invisible.
    beyond = halo_m + 2.0 * SIGHT_PX / camera.scale
    box = _pixels(_clipped(seen, camera, beyond)[0], camera)
    radius = round(halo_m * camera.scale)
    for width, color in ((SIGHT_PX + 2, INK), (SIGHT_PX, zone_color(zone))):
        pygame.draw.rect(surface, color, box, width, border_radius=radius)


def _clipped(
    rects: NDArray[np.float64], camera: Viewport, beyond_m: float = 0.0
) -> NDArray[np.float64]:
    """Clip rectangles (k, 4) to `beyond_m` around the view."""
    low, high = np.array(camera.bounds).reshape(2, 2) + np.array([[-beyond_m], [beyond_m]])
    return np.clip(rects, np.tile(low, 2), np.tile(high, 2))


def _pixels(rect: NDArray[np.float64], camera: Viewport) -> tuple[int, int, int, int]:
    """Convert a rectangle in metres to left, top, width and height in pixels."""
    (left, bottom), (right, top) = np.rint(camera.to_pixels(rect.reshape(2, 2))).astype(int)
    return int(left), int(top), int(right - left), int(bottom - top)


def _number(surface: Surface, zone: int, room: Rect) -> None:
    """Draw the zone's number in the middle of its visible part, if it fits."""
    pygame = load_pygame()
    color = zone_color(zone)
    text = lettering(str(zone), NUMBER_PX, ink_on(color))
    plate = text.get_rect(center=room.center).inflate(2 * NUMBER_PADDING_PX, NUMBER_PADDING_PX)
    if room.contains(plate):
        pygame.draw.rect(surface, color, plate, border_radius=NUMBER_PADDING_PX)
        surface.blit(text, text.get_rect(center=room.center))


# Distance between a vehicle and the ring around it, and smallest radius of a ring.
GAP_PX = 4.0
MIN_RADIUS_PX = 10.0


def owner_paints(
    view: ZoneView, vehicles: NDArray[np.void], seen: NDArray[np.void], ghosts_of: int | None
) -> list[Paint]:
    """Return the paint of vehicles by their zones.

    `vehicles`: all vehicles, as from `Simulation.vehicles`. `seen`: the vehicles to draw, in any
    order. `ghosts_of`: zone whose ghosts get a rim in its colour, or None.
    """
    owners = dict(zip(vehicles["id"].tolist(), view.owners.tolist(), strict=True))
    ghosts = set() if ghosts_of is None else set(view.ghosts[ghosts_of].tolist())
    rims = () if ghosts_of is None else (INK, zone_color(ghosts_of))
    return [
        Paint(zone_color(owners[i]), rims if i in ghosts else (), lined=True)
        for i in seen["id"].tolist()
    ]


def draw_transfers(
    surface: Surface, view: ZoneView, vehicles: NDArray[np.void], camera: Viewport
) -> None:
    """Draw a ring in the target's colour around each vehicle in transfer, with an arrow head.

    `vehicles`: all vehicles; a transfer of a vehicle that has left is not drawn.
    """
    rows = {int(row["id"]): row for row in vehicles}
    for transfer in view.transfers:
        row = rows.get(transfer.vehicle)
        if row is None:
            continue
        place = np.array([row["x"], row["y"]])
        x, y = camera.to_pixels(place).tolist()
        east, north = _towards(view.partition, transfer, place, float(row["heading"]))
        radius = max(0.5 * float(row["length"]) * camera.scale + GAP_PX, MIN_RADIUS_PX)
        color = zone_color(transfer.target)
        stamp(surface, pointer(x, y, radius, (east, -north), color))


def _towards(
    partition: ZonePartition, transfer: TransferInFlight, place: NDArray[np.float64], heading: float
) -> tuple[float, float]:
    """Return the direction in the plane from the source zone to the target zone, near a vehicle.

    If the vehicle is on the border itself, the result is the direction of the vehicle.
    """
    source, target = partition.reaching[[transfer.source, transfer.target]]
    way = np.clip(place, target[:2], target[2:]) - np.clip(place, source[:2], source[2:])
    length = float(np.hypot(*way))
    if length == 0.0:
        return float(np.cos(heading)), float(np.sin(heading))
    return float(way[0] / length), float(way[1] / length)
