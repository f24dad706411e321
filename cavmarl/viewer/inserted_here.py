"""What pages put into a world: a vehicle, or a barrier, which they also take away again."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from cavmarl.core.errors import ActionError, CapacityError, ConfigError
from cavmarl.env.insertions import CLOSED, INSERTED, OPENED
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork
from cavmarl.viewer.map_geometry import map_origin
from cavmarl.viewer.page_requests import PageRequest
from cavmarl.viewer.subscribers import Audience
from cavmarl.viewer.vehicle_details import Shown

FARTHEST_M = 30.0  # from the middle of a lane
_CARS = 1 << VEHICLE_CLASSES.index("passenger")


def put_in(
    env: Shown, world: int, audience: Audience, watcher: int, request: PageRequest, tick: int
) -> bool:
    """Heed a page that wants to insert a vehicle, to close or to open a road; whether it was one.

    Args:
        env: whose world it is.
        world: its number.
        audience: is told of it, on the time line.
        watcher: the page, which is told why it cannot be.
        request: of the page.
        tick: of the world now.
    """
    if request.kind not in ("insert", "close", "open"):
        return False
    try:
        kind, detail = _put_in(env, world, request)
    except (ActionError, CapacityError, ConfigError) as error:
        audience.tell(watcher, {"kind": "notice", "text": str(error)})
    else:
        audience.tell_events([[tick, kind, -1, -1, detail]])
    return True


def _put_in(env: Shown, world: int, request: PageRequest) -> tuple[str, str]:
    """Do it; kind and detail of the event that tells of it."""
    network = env.network
    among = env.closed_roads(world) if request.kind == "open" else None
    lane, place_m = lane_at(network, request.x, request.y, among)
    edge = network.edge_ids[int(network.lanes["edge"][lane])]
    if request.kind == "insert":
        env.insert_vehicle(network.lane_ids[lane], place_m, world)
        return INSERTED, network.lane_ids[lane]
    if request.kind == "close":
        env.close_road(edge, world)
        return CLOSED, edge
    env.open_road(edge, world)
    return OPENED, edge


def lane_at(
    network: RoadNetwork, x: float, y: float, among: Collection[str] | None = None
) -> tuple[int, float]:
    """The lane of a road that is nearest to a place, and where on it that is.

    Args:
        network: the map.
        x: m from `map_origin`.
        y: likewise.
        among: ids of edges, of which it is one; None: any.

    Returns:
        LANE row, and m along it.

    Raises:
        ActionError: none that cars drive on is within `FARTHEST_M`.
    """
    lanes = network.lanes
    usable = ~lanes["internal"] & ((lanes["permissions"] & _CARS) != 0)
    if among is not None:
        usable &= np.isin(lanes["edge"], [network.edge_ids.index(edge) for edge in among])
    rows = np.flatnonzero(usable)
    counts = lanes["num_points"][rows] - 1
    of_piece = np.repeat(rows, counts)
    within = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
    start = lanes["first_point"][of_piece] + within
    points = np.stack([network.points["x"], network.points["y"]], axis=1)
    here = np.array([x, y]) + map_origin(network)
    along = points[start + 1] - points[start]
    lengths = np.maximum(np.hypot(*along.T), 1e-9)
    shares = np.clip(((here - points[start]) * along).sum(axis=1) / lengths**2, 0.0, 1.0)
    away = np.hypot(*(points[start] + along * shares[:, None] - here).T)
    nearest = int(away.argmin()) if len(away) else -1
    if nearest < 0 or away[nearest] > FARTHEST_M:
        what = "road for cars" if among is None else "closed road"
        raise ActionError(f"there is no {what}: choose a place nearer to one")
    lane = int(of_piece[nearest])
    before = (of_piece == lane) & (within < within[nearest])
    place_m = float(lengths[before].sum() + shares[nearest] * lengths[nearest])
    return lane, min(place_m, float(lanes["length_m"][lane]))
