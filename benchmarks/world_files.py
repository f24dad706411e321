"""The files of a random world, by netgenerate, netconvert and randomTrips of SUMO's wheel."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, ElementTree, SubElement, indent

import defusedxml.ElementTree
import numpy as np

from benchmarks.world_draw import DemandDraw, WorldDraw
from cavmarl.core.errors import ConfigError, MapError, require
from cavmarl.core.processes import dying_with_parent
from cavmarl.maps.map_kinds import MAP_ENDINGS
from cavmarl.maps.netconvert import build_network, map_file
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork

NET_FILE, ROUTES_FILE = "world.net.xml", "world.rou.xml"
# Maps of real cities in the wheel's `tools/game` for cuts; roads have heights.
GAME_MAPS = ("kuehne/kuehne", "bs3d/bs", "fokr_bs_demo/fokr_bs", "DRT/osm", "fkk_in/ingolstadt")
_DRAWN_TRIPS = 1500  # number of trips that randomTrips draws
_LEAST_EDGES = 12  # cuts with fewer edges are drawn again
_CUTS = 20  # attempts to cut a piece with roads
_END_PER_H = 600.0  # upper bound of the flow on a road into the net, so that vehicles can enter
_TOOL_S = 300.0


def cut_maps(folder: Path | None) -> tuple[Path, ...]:
    """Return the maps for cuts: all maps below a folder, or the maps in the wheel.

    Raises ConfigError: the folder has no map.
    """
    if folder is None:
        games = Path(require("sumo", "sumo").SUMO_HOME) / "tools" / "game"
        found = [path for name in GAME_MAPS for path in games.glob(f"{name}.net.xml*")]
    else:
        found = sorted(path for path in folder.rglob("*") if path.name.endswith(MAP_ENDINGS))
    if not found:
        raise ConfigError(f"--maps {folder}: has no map ({', '.join(MAP_ENDINGS)})")
    return tuple(found)


def make_files(
    draw: WorldDraw, folder: Path, seconds: int, maps: Sequence[Path]
) -> tuple[Path, Path]:
    """Write net and routes of a world to a folder; the same draw gives the same traffic.

    Args:
        draw: the world.
        folder: created if missing.
        seconds: period of departures.
        maps: maps for cuts.

    Returns:
        the net and the routes.

    Raises:
        ConfigError: a tool of SUMO fails.
        MapError: a cut of a map has no drivable roads.
        MissingExtraError: SUMO is not installed.
    """
    net, routes = make_net(draw, folder, maps), folder / ROUTES_FILE
    _write_demand(draw, net, routes, seconds)
    return net, routes


def make_net(draw: WorldDraw, folder: Path, maps: Sequence[Path]) -> Path:
    """Write the net of a world to a folder, as in `make_files`."""
    folder.mkdir(parents=True, exist_ok=True)
    net = folder / NET_FILE
    if draw.net.kind == "cut":
        _cut(draw, net, maps)
    elif draw.net.kind == "zipper":
        _zippers(draw, net)
    else:
        _run_tool(
            "bin/netgenerate", *draw.net.options, f"--seed={draw.seed}", f"--output-file={net}"
        )
    return net


def _cut(draw: WorldDraw, net: Path, maps: Sequence[Path]) -> None:
    """Cut a square around a position on a road."""
    random = np.random.default_rng([draw.seed, 1])
    for _ in range(_CUTS):
        source = map_file(maps[int(random.integers(len(maps)))])
        points = load_network(source).points
        point = points[int(random.integers(len(points)))]
        x, y, half = float(point["x"]), float(point["y"]), draw.net.length_m
        box = f"{x - half:.1f},{y - half:.1f},{x + half:.1f},{y + half:.1f}"
        options = (*draw.net.options, f"--keep-edges.in-boundary={box}")
        try:
            build_network(source, net, options=options)
        except MapError:
            continue  # no drivable road
        if int((~load_network(net).edges["internal"]).sum()) >= _LEAST_EDGES:
            return
    raise MapError(
        f"{source}: {_CUTS} cuts of {2 * half:.0f} m have too few roads; give larger maps"
    )


def _zippers(draw: WorldDraw, net: Path) -> None:
    """Build a two-way road on which the two inner lanes merge at each node."""
    most = draw.net.num_lanes
    nodes, edges, connections = (Element(name) for name in ("nodes", "edges", "connections"))
    for n in range(most + 1):
        kind = {"type": "zipper"} if 0 < n < most else {}
        SubElement(nodes, "node", kind | {"id": f"n{n}", "x": str(n * draw.net.length_m), "y": "0"})
    for way, begin in (("f", range(most)), ("b", range(most, 0, -1))):
        for k, (n, lanes) in enumerate(zip(begin, range(most, 0, -1), strict=True)):
            ends = {"from": f"n{n}", "to": f"n{n + (1 if way == 'f' else -1)}"}
            SubElement(edges, "edge", ends | {"id": f"{way}{k}", "numLanes": str(lanes)})
            for lane in range(lanes if lanes > 1 else 0):
                row = {"from": f"{way}{k}", "to": f"{way}{k + 1}", "fromLane": str(lane)}
                SubElement(connections, "connection", row | {"toLane": str(min(lane, lanes - 2))})
    options = []
    for name, root in (("node", nodes), ("edge", edges), ("connection", connections)):
        path = net.with_name(f"{name}s.xml")
        ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
        options.append(f"--{name}-files={path}")
    _run_tool("bin/netconvert", *options, *draw.net.options, f"--output-file={net}")


def _write_demand(draw: WorldDraw, net: Path, routes: Path, seconds: int) -> None:
    """Write routes of randomTrips, with departures by the flow of the draw."""
    drawn = routes.with_name("drawn.rou.xml")
    network = load_network(net)
    # With few ends of roads, trips begin anywhere; otherwise all traffic would be on two edges.
    fringe = draw.demand.fringe and _num_ends(network) >= 4
    _run_tool(
        "tools/randomTrips.py",
        f"--net-file={net}",
        f"--output-trip-file={routes.with_name('trips.xml')}",
        f"--route-file={drawn}",
        f"--end={_DRAWN_TRIPS}",
        f"--seed={draw.seed}",
        "--random-depart",
        "--lanes",
        "--threads=1",
        f"--fringe-factor={'max' if fringe else 1}",
        f"--min-distance={draw.net.length_m}",
        "--edge-permission=passenger",
    )
    found = list(defusedxml.ElementTree.parse(drawn).iter("vehicle"))
    for name in ("drawn.rou.xml", "drawn.rou.alt.xml", "trips.xml"):
        routes.with_name(name).unlink(missing_ok=True)
    if not found:
        raise ConfigError(f"{net}: randomTrips found no trip; use another seed")
    gap_s = _gap_s(draw.demand, network, found)
    if fringe:
        gap_s = max(gap_s, 3600.0 / (_END_PER_H * _num_ends(network)))
    _routes_of(draw, found, gap_s, seconds).write(routes, encoding="utf-8", xml_declaration=True)


def _num_ends(network: RoadNetwork) -> int:
    """Return the number of junctions with one road."""
    edges = network.edges[~network.edges["internal"]]
    junctions = np.concatenate([edges["from_junction"], edges["to_junction"]])
    ends = np.concatenate([edges["to_junction"], edges["from_junction"]])
    pairs = np.unique(np.stack([junctions, ends], axis=1), axis=0)
    return int((np.bincount(pairs[:, 0]) == 1).sum())


def _gap_s(demand: DemandDraw, network: RoadNetwork, found: Sequence[Element]) -> float:
    """Return the time between departures in s that gives a typical junction the drawn flow."""
    edges = network.edges[~network.edges["internal"]]
    num_junctions = len(np.unique(edges["to_junction"])) - _num_ends(network)
    lanes = float(edges["num_lanes"].mean())
    passed = [len(str(route.get("edges")).split()) - 1 for one in found for route in one]
    # Lanes of one road share the capacity of a junction.
    flow_per_h = demand.junction_per_h * lanes**0.5 * max(num_junctions, 1)
    gap_s: float = 3600.0 * max(float(np.mean(passed)), 1.0) / flow_per_h
    return gap_s


def _routes_of(
    draw: WorldDraw, found: Sequence[Element], gap_s: float, seconds: int
) -> ElementTree[Element]:
    random = np.random.default_rng([draw.seed, 2])
    root = Element("routes")
    classes = list(draw.demand.shares)
    for name in classes:
        SubElement(root, "vType", id=name, vClass=name)
    kinds = random.choice(len(classes), len(found), p=list(draw.demand.shares.values()))
    departs = np.cumsum(random.exponential(gap_s, len(found)))
    for number, (one, kind, depart_s) in enumerate(zip(found, kinds, departs, strict=True)):
        if depart_s < seconds:
            own = {"id": str(number), "type": classes[kind], "depart": f"{depart_s:.2f}"}
            vehicle = SubElement(root, "vehicle", own | draw.demand.departure)
            SubElement(vehicle, "route", edges=str(one[0].get("edges")))
    indent(root)
    return ElementTree(root)


def _run_tool(tool: str, *options: str) -> None:
    home = Path(require("sumo", "sumo").SUMO_HOME)
    command = [str(home / tool), *options]
    if tool.endswith(".py"):
        command.insert(0, sys.executable)
    own = {"SUMO_HOME": str(home)}
    done = subprocess.run(
        dying_with_parent(command),
        capture_output=True,
        text=True,
        errors="replace",
        timeout=_TOOL_S,
        env=os.environ | own,
        check=False,
    )
    if done.returncode != 0:
        said = done.stderr.strip().splitlines()[-5:]
        raise ConfigError(f"{tool} {' '.join(options)}: failed: {' '.join(said)}")
