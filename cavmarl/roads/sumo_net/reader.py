"""Reads SUMO networks: sumolib parses the file, this module fills a `RoadNetwork`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.atomic_file import sha256_of
from cavmarl.core.errors import MapError
from cavmarl.core.math.elementary_arrays import atan2_all
from cavmarl.core.math.geometry import project
from cavmarl.core.records.codes import NO_CHANGE_LEFT, NO_CHANGE_RIGHT
from cavmarl.core.records.rows import FORK_BEYOND_M, STEERED, SWEPT_BEYOND_M
from cavmarl.core.scene_names import SCENE_SUFFIXES
from cavmarl.roads.contraflow_ids import is_contraflow
from cavmarl.roads.network import (
    EDGE,
    JUNCTION,
    LANE,
    LINK,
    GeoReference,
    RoadNetwork,
)
from cavmarl.roads.polylines import (
    Shape,
    clean_shape,
    extend_stubs,
    point_rows,
    refuse_points,
    split_beside_ends,
)
from cavmarl.roads.sumo_net.backward_paths import Way, mend_backward_paths
from cavmarl.roads.sumo_net.conflicts import (
    LinkPath,
    conflict_rows,
    fill_conflicts,
    fork_lengths,
    sample_path,
    stop_back,
)
from cavmarl.roads.sumo_net.detectors import DetectorRoads, place_detectors
from cavmarl.roads.sumo_net.road_corners import round_corners
from cavmarl.roads.sumo_net.selection import (
    ALL_CLASSES,
    Movement,
    NetworkSelection,
    permission_bits,
    select,
)
from cavmarl.roads.sumo_net.shared_strips import Road, find_strips, move_apart
from cavmarl.roads.sumo_net.signal_rows import SignalRows, read_signals
from cavmarl.roads.sumo_net.sweeps import AHEAD_M, Movements, sweep_rows, unfed_beside
from cavmarl.roads.sumo_net.xml_source import limit

if TYPE_CHECKING:
    from cavmarl.roads.sumo_net.sumo_xml import ParsedNet

APPROACH_M = 12.0  # up to this far before a junction, bodies may be oblique to waiting vehicles
FORK_WATCHED_M = 5.0  # rears up to this far after a junction may still cover a path that forks off
MAX_CROSSING_M = 2000  # maximum length of a path over a junction; memory grows with its square
MOST_CROSSING = "CAVMARL_MAX_CROSSING_M"  # environment variable that overrides this limit
_NAMED = 5  # maximum number of changed lanes named in a note
_ENDINGS = (".gz", ".xml", ".net", ".osm", ".xodr", ".sumocfg", *SCENE_SUFFIXES)


def map_name(path: Path) -> str:
    """Return a map file's name without its suffixes."""
    name = path.name
    for ending in _ENDINGS:
        name = name.removesuffix(ending)
    return name


def source_hash(path: Path) -> str:
    """Return the SHA-256 of a file, hex.

    Raises MapError: the file cannot be read.
    """
    try:
        return sha256_of(path)
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror or error})") from error


def read_network(path: str | Path) -> RoadNetwork:
    """Read a SUMO network file (`.net.xml`, `.net.xml.gz`).

    Lane lengths are lengths of the polylines; EDGE["length_m"] is the length stated in the map.

    Raises MapError: the file is broken, malicious or inconsistent, or has no drivable lane.
    """
    # Import sumolib only here, because networks in the cache do not need it.
    from cavmarl.roads.sumo_net.sumo_xml import parse_net

    path = Path(path)
    digest = source_hash(path)
    try:
        return _assemble(parse_net(path), map_name(path), digest)
    except MapError as error:
        if str(error).startswith(str(path)):
            raise
        raise MapError(f"{path}: {error}") from error


def _assemble(parsed: ParsedNet, name: str, digest: str) -> RoadNetwork:
    net = parsed.net
    chosen = select(net)
    if not chosen.edges:
        raise MapError(
            "no lane that road vehicles may use: check the lanes' permissions, and which "
            "edges netconvert kept (--keep-edges.by-vclass)"
        )
    movements = chosen.movements
    lane_row = {id(lane): row for row, lane in enumerate(chosen.lanes)}
    signal_rows = read_signals(parsed.programs)
    nodes = net.getNodes()
    node_row = {id(node): row for row, node in enumerate(nodes)}

    num_normal = sum(lane.getEdge().getFunction() == "" for lane in chosen.lanes)
    lane_ids = tuple(lane.getID() for lane in chosen.lanes)
    shapes, notes = _shapes(chosen, lane_row, lane_ids[:num_normal], parsed.left_hand)
    edges = _edge_rows(chosen, net, node_row)
    outer = _outer_rows(chosen, edges)
    split_beside_ends(shapes, outer[outer < num_normal])
    points, first_point = point_rows(shapes)

    lanes = _lane_rows(chosen, edges, points, first_point, outer, parsed.left_hand)
    _bar_changes(lanes, lane_ids, parsed)
    links = _link_rows(movements, lane_row, lanes, node_row, signal_rows)
    into = _connect(lanes, links, movements, lane_row)
    paths = [_path(move, lane_row, lanes, points) for move in movements]
    ways = [_path(move, lane_row, lanes, points, AHEAD_M, AHEAD_M) for move in movements]
    conflicts, first_conflict, unruled = conflict_rows(movements, paths, ways, parsed.left_hand)
    fork_m = fork_lengths(links["from_lane"].tolist(), paths)
    links["fork_m"] = np.minimum(fork_m, links["length_m"] + FORK_BEYOND_M)
    _map_neighbors(lanes, points)
    lanes["stop_back_m"] = stop_back(
        _lane_ends(lanes, points),
        lanes["edge"],
        links["from_lane"].tolist(),
        links["junction"].tolist(),
        paths,
        [_path(move, lane_row, lanes, points, APPROACH_M) for move in movements],
        ways,
    )
    _add_stop_offsets(lanes, lane_ids, parsed.stop_offsets_m)
    fill_conflicts(lanes, links, conflicts, first_conflict)
    unfed = unfed_beside(links, lanes, points)
    sweeps = _fill_sweeps(Movements(links, conflicts, ways, unfed))
    junctions, kinds = _junction_rows(nodes, links)
    junctions["unruled"][links["junction"][unruled]] = True
    detectors, phase_detectors = place_detectors(
        signal_rows, DetectorRoads(lanes, edges, links, conflicts, into, lane_ids)
    )
    return RoadNetwork(
        name=name,
        source_hash=digest,
        points=points,
        lanes=lanes,
        edges=edges,
        links=links,
        conflicts=conflicts,
        sweeps=sweeps,
        junctions=junctions,
        into=into,
        **signal_rows.arrays()._asdict(),
        detectors=detectors,
        phase_detectors=phase_detectors,
        lane_ids=lane_ids,
        edge_ids=tuple(edge.getID() for edge in chosen.edges),
        junction_ids=tuple(node.getID() for node in nodes),
        signal_ids=tuple(signal_rows.ids),
        junction_kinds=kinds,
        geo=_geo_reference(net),
        left_hand=parsed.left_hand,
        notes=(*parsed.notes, *notes),
    )


def _bar_changes(lanes: NDArray[np.void], lane_ids: Sequence[str], parsed: ParsedNet) -> None:
    """Set the bits of classes that must not change lanes.

    SUMO's "left" is towards the middle of the road, which is to the right in left-hand traffic.
    """
    inwards, outwards = NO_CHANGE_LEFT, NO_CHANGE_RIGHT
    if parsed.left_hand:
        inwards, outwards = outwards, inwards
    for row, name in zip(lanes, lane_ids, strict=True):
        if name in parsed.changes and not row["internal"]:
            to_left, to_right = map(permission_bits, parsed.changes[name])
            row["permissions"] |= (ALL_CLASSES & ~to_left) << inwards
            row["permissions"] |= (ALL_CLASSES & ~to_right) << outwards


def _add_stop_offsets(
    lanes: NDArray[np.void], lane_ids: Sequence[str], offsets_m: dict[str, float]
) -> None:
    """Move stop lines back; the offset of a lane overrides the offset of its edge."""
    for row, name in zip(lanes, lane_ids, strict=True):
        offset_m = offsets_m.get(name, offsets_m.get(name.rpartition("_")[0], 0.0))
        if offset_m > 0.0 and not row["internal"]:
            most_m = max(float(row["length_m"]) - 1.0, 0.0)
            row["stop_back_m"] = max(float(row["stop_back_m"]), min(offset_m, most_m))


def _shapes(
    chosen: NetworkSelection, lane_row: dict[int, int], normal_ids: Sequence[str], left_hand: bool
) -> tuple[list[Shape], tuple[str, ...]]:
    """Return the drivable centre line of each lane, (n, 3) in m, and notes on changed lanes.

    Lanes of roads come first, then internal lanes.
    """
    shapes = [clean_shape(lane.getShape3D()) for lane in chosen.lanes]
    refuse_points(shapes[: len(normal_ids)], normal_ids)
    widths_m = [lane.getWidth() for lane in chosen.lanes]
    ways = [_way(move, lane_row) for move in chosen.movements]
    roads = _roads(chosen, len(normal_ids))
    notes = []
    strips = find_strips(shapes, widths_m, roads, left_hand)
    if strips:
        move_apart(shapes, strips, ways, left_hand)
        ids = _some(
            [f"{normal_ids[a]} and {normal_ids[b]}" for one in strips for a, b in one.lanes]
        )
        most_m = max(strip.apart_m for strip in strips)
        notes.append(
            f"moved {len(strips)} pairs of opposite edges by up to {most_m:.1f} m, because their "
            f"lanes were on the same strip: {ids}"
        )
    rounded = round_corners(shapes, widths_m, [road.lanes for road in roads])
    if rounded:
        ids = _some([normal_ids[row] for row in rounded])
        notes.append(
            f"rounded the corners of {len(rounded)} lanes, which are too tight for a car: {ids}"
        )
    mend_backward_paths(shapes, ways)
    extend_stubs(shapes, _before(chosen, lane_row))
    return shapes, tuple(notes)


def _some(ids: Sequence[str]) -> str:
    return ", ".join(ids[:_NAMED]) + (", …" if len(ids) > _NAMED else "")


def _roads(chosen: NetworkSelection, num_normal: int) -> list[Road]:
    """Return the edges that are not inside a junction, without contraflow lanes."""
    edges = [id(lane.getEdge()) for lane in chosen.lanes[:num_normal]]
    starts = [row for row in range(num_normal) if row == 0 or edges[row] != edges[row - 1]]
    owners = [chosen.lanes[row].getEdge() for row in starts]
    return [
        Road(range(*bounds), id(edge.getFromNode()), id(edge.getToNode()))
        for edge, bounds in zip(owners, pairwise([*starts, num_normal]), strict=True)
        if not is_contraflow(edge.getID())
    ]


def _geo_reference(net: Any) -> GeoReference | None:
    """Return the position of the map on the earth, if its `location` gives it."""
    try:
        if not net.hasGeoProj():
            return None
    except KeyError:  # there is no location
        return None
    try:
        offset_x_m, offset_y_m = net.getLocationOffset()
    except ValueError:
        offset_x_m = offset_y_m = math.nan
    if not (math.isfinite(offset_x_m) and math.isfinite(offset_y_m)):
        raise MapError("netOffset of its location: must be two numbers, x,y in m")
    return GeoReference(net._location["projParameter"], offset_x_m, offset_y_m)


def _before(chosen: NetworkSelection, lane_row: dict[int, int]) -> dict[int, int]:
    """Return the lane row that leads into each internal lane row, in driving order."""
    before: dict[int, int] = {}
    for movement in chosen.movements:
        source = lane_row[id(movement.connection.getFromLane())]
        for lane in movement.chain:
            before[lane_row[id(lane)]] = source
            source = lane_row[id(lane)]
    return before


def _way(movement: Movement, lane_row: dict[int, int]) -> Way:
    return Way(
        lane_row[id(movement.connection.getFromLane())],
        tuple(lane_row[id(lane)] for lane in movement.chain),
        lane_row[id(movement.connection.getToLane())],
    )


def _edge_rows(chosen: NetworkSelection, net: Any, node_row: dict[int, int]) -> NDArray[np.void]:
    counts: dict[int, int] = {}
    for lane in chosen.lanes:
        counts[id(lane.getEdge())] = counts.get(id(lane.getEdge()), 0) + 1
    edges = np.zeros(len(chosen.edges), EDGE)
    first = 0
    for row, edge in enumerate(chosen.edges):
        num_lanes = counts[id(edge)]
        edges[row] = (
            first,
            num_lanes,
            edge.getFunction() == "internal",
            _node_row(edge, edge.getFromNode(), node_row),
            _node_row(edge, edge.getToNode(), node_row),
            edge.getLength(),
            max(lane.getSpeed() for lane in chosen.lanes[first : first + num_lanes]),
        )
        first += num_lanes
    return edges


def _node_row(edge: Any, node: Any, node_row: dict[int, int]) -> int:
    if node is None or node._coord is None:
        raise MapError(
            f"edge '{edge.getID()}' ends at an unknown junction: build the network again with "
            "netconvert"
        )
    return node_row[id(node)]


def _lane_rows(
    chosen: NetworkSelection,
    edges: NDArray[np.void],
    points: NDArray[np.void],
    first_point: NDArray[np.int32],
    outer: NDArray[np.intp],
    left_hand: bool,
) -> NDArray[np.void]:
    lanes = np.zeros(len(chosen.lanes), LANE)
    lanes["edge"] = np.repeat(np.arange(len(edges)), edges["num_lanes"])
    lanes["index"] = np.arange(len(lanes)) - edges["first_lane"][lanes["edge"]]
    lanes["internal"] = edges["internal"][lanes["edge"]]
    lanes["first_point"] = first_point[:-1]
    lanes["num_points"] = np.diff(first_point)
    lanes["length_m"] = points["s"][first_point[1:] - 1]
    lanes["width_m"] = [lane.getWidth() for lane in chosen.lanes]
    lanes["speed_mps"] = [lane.getSpeed() for lane in chosen.lanes]
    lanes["permissions"] = [
        0 if is_contraflow(lane.getEdge().getID()) else permission_bits(lane.getPermissions())
        for lane in chosen.lanes
    ]
    for axis in ("x", "y"):
        lanes[f"min_{axis}"] = np.minimum.reduceat(points[axis], first_point[:-1])
        lanes[f"max_{axis}"] = np.maximum.reduceat(points[axis], first_point[:-1])

    for field in ("left", "right", "successor", "link"):
        lanes[field] = -1
    inwards, outwards = ("right", "left") if left_hand else ("left", "right")
    lanes[inwards][outer] = outer + 1
    lanes[outwards][outer + 1] = outer
    return lanes


def _outer_rows(chosen: NetworkSelection, edges: NDArray[np.void]) -> NDArray[np.intp]:
    """Return the rows of lanes whose neighbour towards the middle of the road is the next row."""
    edge = np.repeat(np.arange(len(edges)), edges["num_lanes"])
    position = np.array([lane.getIndex() for lane in chosen.lanes])
    # An internal junction cuts lanes into parts of different lengths, which are not adjacent.
    uncut = {id(move.chain[0]) for move in chosen.movements if len(move.chain) == 1}
    beside = np.array(
        [not lane.getID().startswith(":") or id(lane) in uncut for lane in chosen.lanes]
    )
    pair = (edge[:-1] == edge[1:]) & (position[:-1] + 1 == position[1:])
    return np.flatnonzero(pair & beside[:-1] & beside[1:])


def _link_rows(
    movements: Sequence[Movement],
    lane_row: dict[int, int],
    lanes: NDArray[np.void],
    node_row: dict[int, int],
    signals: SignalRows,
) -> NDArray[np.void]:
    most_m = limit(MOST_CROSSING, MAX_CROSSING_M)
    links = np.zeros(len(movements), LINK)
    for link, movement in zip(links, movements, strict=True):
        connection = movement.connection
        chain = [lane_row[id(lane)] for lane in movement.chain]
        link["from_lane"] = lane_row[id(connection.getFromLane())]
        link["to_lane"] = lane_row[id(connection.getToLane())]
        link["first_internal"] = chain[0] if chain else -1
        link["next_lane"] = chain[0] if chain else link["to_lane"]
        link["length_m"] = lanes["length_m"][chain].sum()
        if not link["length_m"] <= most_m:
            raise MapError(
                f"the path from lane '{connection.getFromLane().getID()}' to lane "
                f"'{connection.getToLane().getID()}' is {link['length_m']:.6g} m long over the "
                f"junction, more than {most_m} (environment variable {MOST_CROSSING}): repair the "
                "shapes of both lanes"
            )
        # netconvert splits the path of a link where drivers wait inside the junction.
        link["wait_m"] = lanes["length_m"][chain[0]] if len(chain) > 1 else np.inf
        link["junction"] = node_row[id(movement.node)]
        link["index"] = movement.index
        link["signal"], link["signal_index"] = signals.find(connection, movement.node.getType())
        # In left-hand traffic, SUMO writes T for U-turns to the right.
        link["direction"] = ord(connection.getDirection()[0].replace("T", "t"))
        link["state"] = ord(connection.getState()[0])
        link["may_block"] = connection.getParam("keepClear") == "false"
    return links


def _fill_sweeps(movements: Movements) -> NDArray[np.void]:
    """Return the SWEEP rows, and fill the LINK fields that refer to them."""
    sweeps, first = sweep_rows(movements)
    links = movements.links
    links["first_sweep"], links["num_sweeps"] = first[:-1], np.diff(first)
    links["swept_by"] = STEERED
    over_cars = sweeps["own"] == 0
    own = np.repeat(np.arange(len(links)), np.diff(first))[over_cars]
    np.minimum.at(links["swept_by"], own, sweeps["other"][over_cars])
    links["swept_m"] = links["length_m"]
    np.maximum.at(links["swept_m"], sweeps["foe"], sweeps["foe_leave_m"])
    forks = np.bincount(links["from_lane"])[links["from_lane"]] > 1
    watched = np.where(forks, links["length_m"] + FORK_WATCHED_M, 0.0)
    links["swept_m"] = np.maximum(links["swept_m"], watched)
    links["swept_m"] = np.minimum(links["swept_m"], links["length_m"] + SWEPT_BEYOND_M)
    return sweeps


def _map_neighbors(lanes: NDArray[np.void], points: NDArray[np.void]) -> None:
    """Fill the positions of each lane's points on its neighbours, in driving order."""
    for row in lanes:
        own = points[row["first_point"] : row["first_point"] + row["num_points"]]
        for side in ("left", "right"):
            if row[side] < 0:
                continue
            other = lanes[row[side]]
            first, number = int(other["first_point"]), int(other["num_points"])
            reached = 0.0
            for point in own:
                s, _, _, _ = project(points, first, number, point["x"], point["y"])
                reached = max(reached, min(float(s), float(other["length_m"])))
                point[f"{side}_s"] = reached


def _lane_ends(lanes: NDArray[np.void], points: NDArray[np.void]) -> NDArray[np.float64]:
    """Return (L, 4) x, y, z of each lane's last point, and its direction there."""
    last = points[lanes["first_point"] + lanes["num_points"] - 1]
    heading = atan2_all(last["sin"], last["cos"])
    return np.stack([last["x"], last["y"], last["z"], heading], axis=1)


def _connect(
    lanes: NDArray[np.void],
    links: NDArray[np.void],
    movements: Sequence[Movement],
    lane_row: dict[int, int],
) -> NDArray[np.int32]:
    """Fill the connections of lanes: links, successors of internal lanes, and preceding lanes."""
    rows = np.arange(len(lanes))
    lanes["first_link"] = np.searchsorted(links["from_lane"], rows, side="left")
    lanes["num_links"] = np.searchsorted(links["from_lane"], rows, side="right")
    lanes["num_links"] -= lanes["first_link"]

    steps: list[tuple[int, int]] = []
    for number, (link, movement) in enumerate(zip(links, movements, strict=True)):
        offset = 0.0
        source = int(link["from_lane"])
        for lane in movement.chain:
            row = lane_row[id(lane)]
            steps.append((row, source))
            lanes["link"][row] = number
            lanes["link_offset_m"][row] = offset
            offset += lanes["length_m"][row]
            source = row
        steps.append((int(link["to_lane"]), source))
    steps.sort()
    target, into = np.array(steps, dtype=np.int32).reshape(-1, 2).T
    internal = lanes["internal"][into]
    lanes["successor"][into[internal]] = target[internal]
    lanes["first_into"] = np.searchsorted(target, rows, side="left")
    lanes["num_into"] = np.searchsorted(target, rows, side="right") - lanes["first_into"]
    return np.ascontiguousarray(into)


def _path(
    movement: Movement,
    lane_row: dict[int, int],
    lanes: NDArray[np.void],
    points: NDArray[np.void],
    approach_m: float = 0.0,
    beyond_m: float = 0.0,
) -> LinkPath | None:
    """Return the sampled path of a link along its chain of internal lanes.

    The path begins `approach_m` before the junction, at a negative position, and ends `beyond_m`
    after it.
    """
    if not movement.chain:
        return None
    s, xyz = [], []
    if approach_m > 0.0:
        row = lanes[lane_row[id(movement.connection.getFromLane())]]
        part = points[row["first_point"] : row["first_point"] + row["num_points"]]
        begin = max(row["length_m"] - approach_m, 0.0)
        at = np.append(begin, part["s"][part["s"] > begin])
        s.append(at - row["length_m"])
        xyz.append(np.stack([np.interp(at, part["s"], part[axis]) for axis in "xyz"], axis=1))
    for lane in movement.chain:
        row = lanes[lane_row[id(lane)]]
        part = points[row["first_point"] : row["first_point"] + row["num_points"]]
        s.append(part["s"] + row["link_offset_m"])
        xyz.append(np.stack([part["x"], part["y"], part["z"]], axis=1))
    if beyond_m > 0.0:
        row = lanes[lane_row[id(movement.connection.getToLane())]]
        part = points[row["first_point"] : row["first_point"] + row["num_points"]]
        end = min(beyond_m, row["length_m"])
        at = np.append(part["s"][(part["s"] > 0.0) & (part["s"] < end)], end)
        s.append(at + s[-1][-1])
        xyz.append(np.stack([np.interp(at, part["s"], part[axis]) for axis in "xyz"], axis=1))
    return sample_path(np.concatenate(s), np.concatenate(xyz))


def _junction_rows(
    nodes: Sequence[Any], links: NDArray[np.void]
) -> tuple[NDArray[np.void], tuple[str, ...]]:
    kinds = tuple(sorted({node.getType() or "" for node in nodes}))
    junctions = np.zeros(len(nodes), JUNCTION)
    for junction, node in zip(junctions, nodes, strict=True):
        x, y, z = node.getCoord3D() or (0.0, 0.0, 0.0)
        junction["x"], junction["y"], junction["z"] = x, y, z
        junction["kind"] = kinds.index(node.getType() or "")
    junctions["signal"] = -1
    junctions["signal"][links["junction"]] = links["signal"]
    return junctions, kinds
