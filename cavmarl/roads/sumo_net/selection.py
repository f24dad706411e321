"""Selects the drivable part of a SUMO network: the lanes and movements that become rows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from cavmarl.core.errors import MapError
from cavmarl.roads.network import VEHICLE_CLASSES

ALL_CLASSES = (1 << len(VEHICLE_CLASSES)) - 1
_ROAD = sum(1 << bit for bit, name in enumerate(VEHICLE_CLASSES) if name not in ("tram", "bicycle"))


@dataclass(frozen=True)
class Movement:
    """A permitted movement over a junction, before it becomes a LINK."""

    connection: Any  # sumolib's connection that leaves a normal lane
    # sumolib's internal lanes along the movement, in order; empty if the map has none
    chain: tuple[Any, ...]
    node: Any  # sumolib's junction
    index: int  # the movement's bit in the junction's request


@dataclass
class NetworkSelection:
    """The parts of a network that become rows, in row order."""

    edges: list[Any] = field(default_factory=list)  # normal edges first, then internal edges
    lanes: list[Any] = field(default_factory=list)  # grouped by edge, from the kerb to the middle
    movements: list[Movement] = field(default_factory=list)  # sorted by from-lane, then index


def permission_bits(classes: Iterable[str]) -> int:
    """Return the bits of LANE["permissions"] for SUMO's names of vehicle classes."""
    allowed = set(classes)
    if "all" in allowed:
        return ALL_CLASSES
    return sum(1 << bit for bit, name in enumerate(VEHICLE_CLASSES) if name in allowed)


def _is_road(classes: Iterable[str]) -> bool:
    return bool(permission_bits(classes) & _ROAD)


def select(net: Any) -> NetworkSelection:
    """Select the lanes for road vehicles, and the movements between them.

    The selection omits pavements, crossings, walking areas, rails, bicycle lanes, and internal
    lanes that no movement uses.

    Raises MapError: an internal lane belongs to two movements or leads nowhere.
    """
    chosen = NetworkSelection()
    for edge in net.getEdges(withInternal=False):
        lanes = [lane for lane in edge.getLanes() if _is_road(lane.getPermissions())]
        if lanes:
            chosen.edges.append(edge)
            chosen.lanes.extend(lanes)
    kept = {id(lane): row for row, lane in enumerate(chosen.lanes)}
    found = [
        movement
        for node in net.getNodes()
        for movement in _movements(net, node)
        if id(movement.connection.getFromLane()) in kept
        and id(movement.connection.getToLane()) in kept
        and _is_road(movement.connection._allowed)
        and all(_is_road(lane.getPermissions()) for lane in movement.chain)
    ]
    found.sort(key=lambda move: (kept[id(move.connection.getFromLane())], move.index))
    chosen.movements = found

    used: set[int] = set()
    for movement in found:
        for lane in movement.chain:
            if id(lane) in used:
                raise MapError(
                    f"internal lane '{lane.getID()}' belongs to two connections: build the network "
                    "again with netconvert"
                )
            used.add(id(lane))
    for edge in net.getEdges():
        if edge.getFunction() == "internal":
            lanes = [lane for lane in edge.getLanes() if id(lane) in used]
            if lanes:
                chosen.edges.append(edge)
                chosen.lanes.extend(lanes)
    return chosen


def _movements(net: Any, node: Any) -> Iterable[Movement]:
    """Yield all movements over a junction in SUMO's order, which is the order of request bits."""
    index = 0
    for lane_id in node._incLanes or ():
        if not lane_id:
            continue
        lane = _lane(net, lane_id)
        if lane.getEdge().getToNode() is not node:
            raise MapError(
                f"junction '{node.getID()}' lists lane '{lane_id}', which ends elsewhere: build "
                "the network again with netconvert"
            )
        for connection in lane.getOutgoing():
            source = connection.getFrom().getFunction()
            target = connection.getTo().getFunction()
            if target == "walkingarea" or (source == "walkingarea" and target != "crossing"):
                continue
            yield Movement(connection, _chain(net, connection), node, index)
            index += 1


def _chain(net: Any, connection: Any) -> tuple[Any, ...]:
    """Return the internal lanes from a connection's stop line to its target lane."""
    chain: list[Any] = []
    via = connection.getViaLaneID()
    while via:
        lane = _lane(net, via)
        onward = lane.getOutgoing()
        if lane in chain or len(onward) != 1:
            raise MapError(
                f"internal lane '{via}' does not lead to one lane: build the network again with "
                "netconvert, with internal links"
            )
        chain.append(lane)
        via = onward[0].getViaLaneID()
    return tuple(chain)


def _lane(net: Any, lane_id: str) -> Any:
    edge_id, _, index = lane_id.rpartition("_")
    lanes = net.getEdge(edge_id).getLanes() if net.hasEdge(edge_id) else []
    if not index.isdecimal() or int(index) >= len(lanes):
        raise MapError(f"lane '{lane_id}' is referenced but missing: build the network again")
    return lanes[int(index)]
