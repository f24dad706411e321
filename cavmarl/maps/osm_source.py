"""Prepares OSM extracts for netconvert, which misreads some tags of lanes and access.

netconvert reads `turn:lanes` at the end of a way only, does not know `busway=lane`, and opens ways
with `motor_vehicle=no` to cars.
"""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, tostring

from cavmarl.maps.osm_roads import OsmRoads, RoadWay
from cavmarl.roads.sumo_net.xml_source import read_tree

LANE_OPTIONS = ("--osm.turn-lanes", "--osm.lane-access")

_JUNCTION = 3  # a node where this many ends of ways meet, or more, is a junction
_AHEAD = ("turn:lanes", "turn:lanes:forward")
_BACK = "turn:lanes:backward"
_IGNORED = (
    "lanes:bus", "lanes:bus:forward", "lanes:bus:backward", "lanes:psv", "lanes:psv:forward",
    "lanes:psv:backward", "motor_vehicle:forward", "motor_vehicle:backward",
)  # fmt: skip


def prepare_osm(path: Path, roads: OsmRoads, copy: Path, left_hand: bool) -> tuple[str, ...]:
    """Write a changed copy of an extract if a change is necessary.

    `roads`: the roads of the extract; new ways are added.

    Return notes on changes and ignored tags, with counts.
    """
    counts: Counter[str] = Counter()
    for_cars = {name: way for name, way in roads.ways.items() if way.for_cars}
    for way in for_cars.values():
        for key in _IGNORED:
            if key in way.tags:
                counts[f"ways have {key}, which is ignored"] += 1
        if way.tags.get("busway") == "opposite_lane":
            counts["ways have busway=opposite_lane, which is ignored"] += 1
    closed = {name for name, way in for_cars.items() if way.closed_to_cars}
    if closed:
        counts["ways are closed to motor vehicles and left out"] = len(closed)
    open_ways = {name: way for name, way in for_cars.items() if name not in closed}
    cuts = _cuts(open_ways)
    if cuts:
        counts["ways with turn:lanes are cut at a junction"] = len(cuts)
    busways = {name for name, way in open_ways.items() if way.tags.get("busway") == "lane"}
    if closed or cuts or busways:
        root = read_tree(path)
        elements = {way.get("id", ""): way for way in root.iter("way")}
        for name in closed:
            for tag in elements[name].findall("tag[@k='highway']"):
                elements[name].remove(tag)
        for name in busways:
            _set_busway(elements[name], for_cars[name], left_hand)
        _cut_ways(root, roads, elements, cuts)
        copy.write_bytes(tostring(root, "utf-8"))
    return tuple(f"{count} {what}" for what, count in sorted(counts.items()))


def _cuts(ways: dict[str, RoadWay]) -> dict[str, tuple[int, int]]:
    """Return where to cut ways: node indices for forward and backward turn lanes; 0: no cut.

    Turn lanes lead to the junction at the end of their way. If the way is a dead end, they lead to
    the last junction before its end.
    """
    ends: Counter[str] = Counter()
    for way in ways.values():
        ends.update(way.nodes[:1] + way.nodes[-1:])
        ends.update(2 * way.nodes[1:-1])
    found: dict[str, tuple[int, int]] = {}
    for name, way in ways.items():
        inner = [n for n in range(1, len(way.nodes) - 1) if ends[way.nodes[n]] >= _JUNCTION]
        if not inner:
            continue
        ahead = back = 0
        if any(key in way.tags for key in _AHEAD) and ends[way.nodes[-1]] == 1:
            ahead = inner[-1]
        if _BACK in way.tags and ends[way.nodes[0]] == 1:
            back = inner[0]
        if ahead or back:
            found[name] = ahead, back
    return found


def _cut_ways(
    root: Element,
    roads: OsmRoads,
    elements: dict[str, Element],
    cuts: dict[str, tuple[int, int]],
) -> None:
    """Cut ways into up to three parts; the part with forward turn lanes keeps the way's id."""
    free = max((int(name) for name in elements if name.lstrip("-").isdecimal()), default=0) + 1
    parts: dict[str, dict[str, list[str]]] = {}  # nodes of the parts of each way, by their names
    for name, (ahead, back) in cuts.items():
        way, nodes = elements[name], roads.ways[name].nodes
        tags = [(tag.get("k", ""), tag.get("v", "")) for tag in way.iterfind("tag")]
        places = [0, *sorted({ahead, back} - {0}), len(nodes) - 1]
        keeps = places.index(ahead) if ahead else 1
        parts[name] = {}
        for n, (begin, end) in enumerate(pairwise(places), 1):
            kept = dict(tags)
            if end != (ahead or places[-1]):
                for key in _AHEAD:
                    kept.pop(key, None)
            if begin != back:
                kept.pop(_BACK, None)
            own = name if n == keeps else str(free)
            free += own != name
            part = way if own == name else SubElement(root, "way", dict(way.attrib, id=own))
            for child in [*part.iterfind("nd"), *part.iterfind("tag")]:
                part.remove(child)
            for node in nodes[begin : end + 1]:
                SubElement(part, "nd", {"ref": node})
            for key, value in kept.items():
                SubElement(part, "tag", {"k": key, "v": value})
            parts[name][own] = nodes[begin : end + 1]
        for own, refs in parts[name].items():
            roads.ways[own] = RoadWay(refs, roads.ways[name].tags)
    # Relations must come after all ways in the file, including the new ones.
    relations = list(root.iter("relation"))
    for relation in relations:
        root.remove(relation)
        root.append(relation)
        via = {member.get("ref") for member in relation.iterfind("member[@role='via']")}
        for member in relation.iterfind("member[@type='way']"):
            for own, refs in parts.get(member.get("ref", ""), {}).items():
                touches = refs[-1] if member.get("role") == "from" else refs[0]
                if touches in via:
                    member.set("ref", own)
                    break


def _set_busway(element: Element, way: RoadWay, left_hand: bool) -> None:
    one_way = way.tags.get("oneway", "no") in ("yes", "true", "1")
    side = ("left" if left_hand else "right") if one_way else "both"
    for tag in element.iterfind("tag[@k='busway']"):
        tag.set("k", f"busway:{side}")
