"""Small map files, and networks built from them."""

from __future__ import annotations

import math
from pathlib import Path

from cavmarl.maps.netconvert import build_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network

_LANE = '<lane id="{id}" type="driving"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>'
# A straight road of 200 m with a lane in each direction; tests replace `<type/>`.
ROAD = (
    '<road name="" length="200" id="1" junction="-1"><type/><planView>'
    '<geometry s="0" x="0" y="0" hdg="0" length="200"><line/></geometry></planView>'
    f'<lanes><laneSection s="0"><left>{_LANE.format(id=1)}</left>'
    '<center><lane id="0" type="none"/></center>'
    f"<right>{_LANE.format(id=-1)}</right></laneSection></lanes></road>"
)


def road_file(*roads: str) -> str:
    """Return the text of a file with these roads."""
    head = '<header revMajor="1" revMinor="6" name="" north="0" south="0" east="0" west="0"/>'
    return f"<OpenDRIVE>{head}{''.join(roads)}</OpenDRIVE>".replace("<type/>", "")


def built_from(folder: Path, name: str, text: str) -> RoadNetwork:
    """Write a map file, and return the network that is built from it."""
    path = folder / name
    path.write_text(text)
    return read_network(build_network(path, folder / "built.net.xml").path)


# Four two-way arms on a roundabout that is drawn clockwise.
_STEPS = ((1, 0), (0.7, -0.7), (0, -1), (-0.7, -0.7), (-1, 0), (-0.7, 0.7), (0, 1), (0.7, 0.7))
_RING = {100 + k: (20.0 * x, 20.0 * y) for k, (x, y) in enumerate(_STEPS)}
_ARMS = {200 + k: (250.0 * x, 250.0 * y) for k, (x, y) in enumerate(_STEPS) if k % 2 == 0}
ROUNDABOUT = (
    _RING | _ARMS,
    {400: ([*_RING, 100], {"highway": "secondary", "junction": "roundabout"})}
    | {300 + k: ([200 + k, 100 + k], {"highway": "secondary"}) for k in range(0, 8, 2)},
)

Nodes = dict[int, tuple[float, float]]  # node id → (metres to the east, metres to the north)
Ways = dict[int, tuple[list[int], dict[str, str]]]  # way id → (nodes, tags)


def osm_file(roads: tuple[Nodes, Ways], latitude: float, longitude: float) -> str:
    """Return the text of an OSM file with these roads around a place in degrees."""
    nodes, ways = roads
    east = math.cos(math.radians(latitude)) * 111_320.0
    lines = [
        f'<node id="{name}" lat="{latitude + y / 111_320.0:.7f}" lon="{longitude + x / east:.7f}"/>'
        for name, (x, y) in nodes.items()
    ]
    for name, (refs, tags) in ways.items():
        inside = "".join(f'<nd ref="{ref}"/>' for ref in refs)
        inside += "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        lines.append(f'<way id="{name}">{inside}</way>')
    return f'<osm version="0.6">{"".join(lines)}</osm>'
