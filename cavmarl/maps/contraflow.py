"""Networks with contraflow lanes: lanes on a road that lead in the opposite direction.

Each contraflow road is a separate edge in the same place as the road that it reverses. The reader
of networks gives its lanes no permissions, so that no route on the map uses it. A world opens it
after the reversed road has been closed and is empty.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, tostring

from cavmarl.core.atomic_file import draft_folder
from cavmarl.core.cache_folder import cache_dir
from cavmarl.core.errors import ConfigError, MapError, require
from cavmarl.maps.net_document import NetDocument
from cavmarl.maps.netconvert_process import run_netconvert
from cavmarl.maps.provenance import head_of, read_provenance
from cavmarl.roads.contraflow_ids import contraflow_of
from cavmarl.roads.sumo_net.reader import map_name, source_hash
from cavmarl.roads.sumo_net.xml_source import read_tree

# Increase the number when networks are made differently, so that cached networks are made again.
_CONVERSION = "contraflow 1"


def contraflow_network(path: Path, roads: Sequence[str]) -> Path:
    """Return a copy of a SUMO network with contraflow lanes on some roads; it is cached.

    Args:
        path: the network.
        roads: ids of the roads that can be reversed.

    Raises:
        ConfigError: the network has no such road, or the road has no car lane.
        MapError: netconvert fails, or the cache cannot be written.
        MissingExtraError: netconvert is not installed.
    """
    require("sumo", "sumo")
    roads = sorted(set(roads))
    words = [source_hash(path), version("eclipse-sumo"), _CONVERSION, *roads]
    digest = hashlib.sha256("\0".join(words).encode()).hexdigest()
    place = cache_dir() / "maps" / digest[:32] / f"{map_name(path)}.net.xml"
    if place.exists():
        return place
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        with draft_folder(cache_dir() / "maps") as folder:
            os.replace(_make(path, roads, folder), place)
    except OSError as error:
        raise MapError(
            f"{place}: cannot be written ({error.strerror or error}); set CAVMARL_CACHE_DIR to "
            "another folder"
        ) from error
    return place


def _make(path: Path, roads: Sequence[str], folder: Path) -> Path:
    """Write the network with contraflow lanes to a folder; return its path."""
    added = _Contraflow(NetDocument(path), roads)
    plain = folder / "plain"
    run_netconvert(
        ["--sumo-net-file", str(path), "--plain-output-prefix", str(plain), *_EXACT], path, None
    )
    trees = {kind: read_tree(folder / f"plain.{kind}.xml") for kind in _PLAIN.values()}
    trees["edg"].extend(added.edges)
    trees["con"].extend(added.connections)
    trees["tll"].extend(added.controlled(trees["tll"]))
    for kind, tree in trees.items():
        (folder / f"plain.{kind}.xml").write_bytes(tostring(tree))
    draft = folder / f"{map_name(path)}.net.xml"
    arguments = [f"--{word}-files={folder}/plain.{kind}.xml" for word, kind in _PLAIN.items()]
    run_netconvert([*arguments, "-o", str(draft), *_EXACT, *added.side], path, None)
    content = draft.read_bytes()
    facts = read_provenance(path) or {"source": path.name, "source sha256": source_hash(path)}
    facts["contraflow"] = " ".join(roads)
    start = content.index(b"<net ")
    draft.write_bytes(
        b'<?xml version="1.0" encoding="UTF-8"?>\n' + head_of(facts) + content[start:]
    )
    return draft


_PLAIN = {"node": "nod", "edge": "edg", "connection": "con", "tllogic": "tll"}
_EXACT = ("--precision=6", "--no-turnarounds", "--offset.disable-normalization")


class _Contraflow:
    """The elements to add to a network, as netconvert's plain XML, in the order of the roads."""

    def __init__(self, document: NetDocument, roads: Sequence[str]) -> None:
        self._roads = {
            edge.get("id", ""): edge
            for edge in document.root.iter("edge")
            if edge.get("function", "") == ""
        }
        left_hand = document.root.get("lefthand") == "true"
        self.side = ("--lefthand",) if left_hand else ()
        self.edges = [_reversed(self._road(name)) for name in roads]
        self._reverses: Mapping[str, Element] = {name: self._roads[name] for name in roads}
        self.connections = [element for name in roads for element in self._connections(name)]

    def controlled(self, signals: Element) -> Iterable[Element]:
        """Yield the contraflow movements that a signal controls.

        Each has the signal and the link index of the movement beside it on the map's own roads.

        `signals`: the root of a file of signals.
        """
        known: dict[tuple[str, str], list[Element]] = {}
        for link in signals.iter("connection"):
            known.setdefault((link.get("from", ""), link.get("to", "")), []).append(link)
        for one in self.connections:
            ends = self._beside(one.get("from", "")), self._beside(one.get("to", ""))
            beside = known.get(ends)
            if beside is None:
                continue
            same = [link for link in beside if link.get("fromLane") == one.get("fromLane")]
            model = (same or beside)[-1]
            words = {name: model.get(name, "") for name in ("tl", "linkIndex")}
            yield Element("connection", dict(one.items()) | words)

    def _beside(self, name: str) -> str:
        """Return the map's own road beside contraflow lanes and in their direction, else `name`."""
        road = next(
            (edge for key, edge in self._reverses.items() if contraflow_of(key) == name), None
        )
        if road is None:
            return name
        ends = road.get("to"), road.get("from")
        found = (
            key for key, edge in self._roads.items() if (edge.get("from"), edge.get("to")) == ends
        )
        return next(found, name)

    def _road(self, name: str) -> Element:
        road = self._roads.get(name)
        if road is None:
            raise ConfigError(
                f"map.contraflow: the map has no road {name!r}; give ids of roads with car lanes"
            )
        if not any(map(_is_for_cars, road.iter("lane"))):
            raise ConfigError(
                f"map.contraflow: road {name!r} has no lane for cars; give ids of other roads"
            )
        return road

    def _connections(self, name: str) -> Iterable[Element]:
        """Yield the movements into and out of the contraflow lanes of a road."""
        road = self._reverses[name]
        begin, end = road.get("to", ""), road.get("from", "")
        own, lanes = contraflow_of(name), _car_lanes(road)
        for other, edge in self._roads.items():
            if not any(map(_is_for_cars, edge.iter("lane"))):
                continue
            if edge.get("to") == begin and edge.get("from") != end and other != name:
                yield from _beside(other, _car_lanes(edge), own, range(len(lanes)))
            if edge.get("from") == end and edge.get("to") != begin and other != name:
                yield from _beside(own, range(len(lanes)), other, _car_lanes(edge))
        for other, edge in self._reverses.items():
            if edge.get("from") == begin and other != name:
                count = len(_car_lanes(edge))
                yield from _beside(contraflow_of(other), range(count), own, range(len(lanes)))


def _beside(
    source: str, source_lanes: Sequence[int], target: str, target_lanes: Sequence[int]
) -> Iterable[Element]:
    """Yield connections between the innermost lanes of two edges."""
    for before, after in zip(reversed(source_lanes), reversed(target_lanes), strict=False):
        words = {"from": source, "to": target, "fromLane": str(before), "toLane": str(after)}
        yield Element("connection", words)


def _car_lanes(road: Element) -> list[int]:
    return [int(lane.get("index", "0")) for lane in road.iter("lane") if _is_for_cars(lane)]


def _is_for_cars(lane: Element) -> bool:
    allowed, denied = lane.get("allow"), lane.get("disallow", "").split()
    if allowed is not None:
        return bool({"all", "passenger"} & set(allowed.split()))
    return not {"all", "passenger"} & set(denied)


def _reversed(road: Element) -> Element:
    """Return a road's contraflow edge; the edge's first lane is the road's innermost lane."""
    lanes = [lane for lane in road.iter("lane") if _is_for_cars(lane)]
    shapes = [" ".join(reversed(lane.get("shape", "").split())) for lane in lanes]
    edge = Element(
        "edge",
        {
            "id": contraflow_of(road.get("id", "")),
            "from": road.get("to", ""),
            "to": road.get("from", ""),
            "numLanes": str(len(lanes)),
            "priority": road.get("priority", "-1"),
            "shape": shapes[-1],
            "spreadType": "center",
        },
    )
    for index, (lane, shape) in enumerate(zip(reversed(lanes), reversed(shapes), strict=True)):
        words = {"index": str(index), "shape": shape, "speed": lane.get("speed", "13.89")}
        SubElement(edge, "lane", words)
    return edge
