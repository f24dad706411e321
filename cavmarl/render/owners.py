"""Which zone owns a vehicle, which see it as a ghost, and where it is handed over."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cavmarl.handoff.zone_view import TransferInFlight, ZoneView
from cavmarl.render.canvas import stamp
from cavmarl.render.cars import Paint
from cavmarl.render.marks import pointer
from cavmarl.render.palette import INK, zone_color
from cavmarl.render.viewport import Viewport
from cavmarl.zones.partition.zone_partition import ZonePartition

if TYPE_CHECKING:
    from pygame import Surface

# Between a vehicle and the ring around it, and the smallest ring.
GAP_PX = 4.0
MIN_RADIUS_PX = 10.0


def owner_paints(
    view: ZoneView, vehicles: NDArray[np.void], seen: NDArray[np.void], ghosts_of: int | None
) -> list[Paint]:
    """How vehicles are painted by their zones.

    `vehicles`: all of it, as `Simulation.vehicles` gives them. `seen`: those of them that are
    drawn, in any order. `ghosts_of`: the zone whose ghosts get a rim in its colour; None: no
    zone's.
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
    """A ring in the target's colour around each vehicle in transfer, and a head towards it.

    `vehicles`: all of it; a transfer of a vehicle that has left is not drawn.
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
    """From the source to the target, seen from a place at their border: a direction in the plane.

    A vehicle on the border itself is on its way: its own direction.
    """
    source, target = partition.reaching[[transfer.source, transfer.target]]
    way = np.clip(place, target[:2], target[2:]) - np.clip(place, source[:2], source[2:])
    length = float(np.hypot(*way))
    if length == 0.0:
        return float(np.cos(heading)), float(np.sin(heading))
    return float(way[0] / length), float(way[1] / length)
