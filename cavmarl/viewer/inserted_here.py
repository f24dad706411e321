"""Changes by pages: a vehicle that is inserted, a road that is closed or opened."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from cavmarl.core.errors import ActionError, CapacityError, ConfigError
from cavmarl.env.insertions import INSERTED
from cavmarl.env.lane_changes import CLOSED, OPENED
from cavmarl.roads.network import CARS, RoadNetwork
from cavmarl.viewer.map_geometry import map_origin
from cavmarl.viewer.page_requests import PageRequest
from cavmarl.viewer.subscribers import Audience
from cavmarl.viewer.vehicle_details import ViewedEnv

FARTHEST_M = 30.0  # largest distance from a lane's centre


def handle_insertion(
    env: ViewedEnv, world: int, audience: Audience, watcher: int, request: PageRequest, tick: int
) -> bool:
    """Insert a vehicle, or close or open a road; return whether this was such a request.

    Args:
        env: environment of the world.
        world: index of the world.
        audience: receives the result as an event on the time line.
        watcher: the page, which receives an error's reason.
        request: request of the page.
        tick: present tick of the world.
    """
    if request.kind not in ("insert", "close", "open"):
        return False
    try:
        kind, detail = _apply(env, world, request)
    except (ActionError, CapacityError, ConfigError) as error:
        audience.send(watcher, {"kind": "notice", "text": str(error)})
    else:
        audience.send_events([[tick, kind, -1, -1, detail]])
    return True


def _apply(env: ViewedEnv, world: int, request: PageRequest) -> tuple[str, str]:
    """Execute the request; return kind and detail of the resulting event."""
    network = env.network
    among = env.closed_roads(world) if request.kind == "open" else None
    lane, place_m = lane_at(network, request.x, request.y, among)
    edge = network.edge_ids[int(network.lanes["edge"][lane])]
    if request.kind == "insert":
        env.insert_vehicle(network.lane_ids[lane], place_m, world)
        return INSERTED, network.lane_ids[lane]
    if request.kind == "close":
        env.close_road(edge, world=world)
        return CLOSED, edge
    env.open_road(edge, world=world)
    return OPENED, edge


def lane_at(
    network: RoadNetwork, x: float, y: float, among: Collection[str] | None = None
) -> tuple[int, float]:
    """Return the lane nearest to a position, and the position along it.

    Args:
        network: the map.
        x: m from `map_origin`.
        y: m from `map_origin`.
        among: ids of allowed edges; None: all.

    Returns:
        LANE row, and m along it.

    Raises:
        ActionError: no lane for cars is within `FARTHEST_M`.
    """
    lanes = network.lanes
    usable = ~lanes["internal"] & ((lanes["permissions"] & CARS) != 0)
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
        kind = "road for cars" if among is None else "closed road"
        raise ActionError(f"there is no {kind} within {FARTHEST_M:g} m: choose a nearer place")
    lane = int(of_piece[nearest])
    before = (of_piece == lane) & (within < within[nearest])
    place_m = float(lengths[before].sum() + shares[nearest] * lengths[nearest])
    return lane, min(place_m, float(lanes["length_m"][lane]))
