"""Splits roads over junctions if their lanes are not neighbours on the road before or after.

netconvert writes all lanes that lead from one road to another as one road, side by side. If a lane
between them leads elsewhere, or two lanes end in one lane, the drawn lanes have gaps or overlap.
"""

from __future__ import annotations

from copy import deepcopy
from itertools import count
from xml.etree.ElementTree import Element

LANES = "lanes/laneSection/right/lane"


def part_roads(root: Element) -> int:
    """Write each group of neighbouring lanes as a separate road; return the number of new roads."""
    connections = {
        connection.get("connectingRoad", ""): (junction, connection)
        for junction in root.iter("junction")
        for connection in junction.iter("connection")
    }
    roads = root.findall("road")
    numbers = count(1 + max((int(road.get("id", "0")) for road in roads), default=0))
    added = 0
    for road in roads:
        groups = _groups(road)
        if len(groups) < 2 or road.get("id", "") not in connections:
            continue
        junction, connection = connections[road.get("id", "")]
        parts = [(road, connection)]
        for _ in groups[1:]:
            parts.append(_copied(road, connection, str(next(numbers))))
        place = list(root).index(road)
        for (part, link), kept in zip(parts, groups, strict=True):
            _keep(part, link, kept)
        for part, link in parts[1:]:
            place += 1
            root.insert(place, part)
            link.set("id", str(1 + max(int(one.get("id", "0")) for one in junction)))
            junction.append(link)
        added += len(groups) - 1
    return added


def _groups(road: Element) -> list[list[str]]:
    """Return the ids of lanes in groups of lanes that are neighbours at both ends."""
    groups: list[list[str]] = []
    before: tuple[int, int] | None = None
    for lane in road.findall(LANES):
        links = lane.find("link/predecessor"), lane.find("link/successor")
        if links[0] is None or links[1] is None:
            return []
        ends = int(links[0].get("id", "0")), int(links[1].get("id", "0"))
        if before is None or ends != (before[0] - 1, before[1] - 1):
            groups.append([])
        groups[-1].append(lane.get("id", ""))
        before = ends
    return groups


def _copied(road: Element, connection: Element, number: str) -> tuple[Element, Element]:
    """Return copies of a road and its connection with another number, without objects."""
    part, link = deepcopy(road), deepcopy(connection)
    part.set("id", number)
    link.set("connectingRoad", number)
    for kind in ("objects", "signals"):
        for found in part.findall(kind):
            part.remove(found)
    return part, link


def _keep(road: Element, connection: Element, ids: list[str]) -> None:
    """Keep only lanes with the given ids on a road, and number them from the inside."""
    names = {name: str(-number) for number, name in enumerate(ids, start=1)}
    for right in road.iterfind("lanes/laneSection/right"):
        for lane in right.findall("lane"):
            if lane.get("id", "") in names:
                lane.set("id", names[lane.get("id", "")])
            else:
                right.remove(lane)
    for link in connection.findall("laneLink"):
        if link.get("to", "") in names:
            link.set("to", names[link.get("to", "")])
        else:
            connection.remove(link)
