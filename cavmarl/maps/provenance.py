"""The origin of a map, stored in its file as a comment: one `key: value` per line."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cavmarl.core.xml_root import head_of_file
from cavmarl.maps.net_document import NetDocument
from cavmarl.maps.osm_roads import OsmRoads

OSM_LICENCE = (
    "Open Data Commons Open Database License (ODbL) 1.0, "
    "https://opendatacommons.org/licenses/odbl/1-0/"
)
OSM_ATTRIBUTION = "© OpenStreetMap contributors, https://www.openstreetmap.org/copyright"
NOT_STATED = "not stated: see the source"
NOTE_SEPARATOR = "; "

_TITLE = "map built by cavmarl"
_COMMENT = re.compile(rf"<!-- {_TITLE}\n(.*?)-->", re.DOTALL)
_GUESSED = {"lanes": "numLanes", "maxspeed": "speed", "width": "width"}


@dataclass(frozen=True)
class RoadDefaults:
    """A value of netconvert's type map, used for roads of one kind that do not state it."""

    kind: str  # OSM's `highway`, as named by netconvert; the type of a road of OpenDRIVE
    edges: int  # number of edges (OSM) or roads (OpenDRIVE)
    guessed: str  # the guessed value: lanes, maxspeed or width
    value: str  # the most frequent value; speeds in m/s, widths in m
    used_for: int  # number of edges or roads without the value

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def head_of(facts: Mapping[str, str]) -> bytes:
    """Return the comment for a map's file."""
    lines = [f"{key}: {' '.join(value.split())}" for key, value in facts.items()]
    text = "\n".join(lines).replace("--", "- -")
    return f"<!-- {_TITLE}\n{text}\n-->\n".encode()


def read_provenance(path: Path) -> dict[str, str]:
    """Return the origin of a map from its file; empty if the file does not give it."""
    found = _COMMENT.search(head_of_file(path).decode("utf-8", errors="replace"))
    lines = found[1].splitlines() if found else []
    return dict(line.split(": ", 1) for line in lines if ": " in line)


def road_defaults(document: NetDocument, roads: OsmRoads) -> tuple[RoadDefaults, ...]:
    """Return the kinds of road with guessed lanes, speeds and widths, and their counts."""
    counts: Counter[str] = Counter()
    values: dict[tuple[str, str], Counter[str]] = {}
    seen = set()
    for lane in document.lanes:
        name = lane.edge.get("id", "")
        if lane.internal or name in seen:
            continue
        seen.add(name)
        kind = lane.edge.get("type", "")
        counts[kind] += 1
        ways = [roads.ways[way] for way in lane.ways if way in roads.ways]
        built = {
            "numLanes": str(sum(1 for _ in lane.edge.iter("lane"))),
            "speed": lane.element.get("speed", ""),
            "width": lane.element.get("width", "3.20"),
        }
        for tag, field in _GUESSED.items():
            if not all(tag in way.tags for way in ways) or not ways:
                values.setdefault((kind, tag), Counter())[built[field]] += 1
    return tuple(
        RoadDefaults(kind, counts[kind], tag, found.most_common(1)[0][0], found.total())
        for (kind, tag), found in sorted(values.items())
    )


def defaults_text(defaults: Iterable[RoadDefaults], counted: str) -> str:
    """Return the defaults for a comment; `counted`: the counted unit, edges or roads."""
    return "; ".join(
        f"{row.kind} {row.guessed}={row.value} ({row.used_for} of {row.edges} {counted})"
        for row in defaults
    )
