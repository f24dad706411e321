"""OpenDRIVE by netconvert, mended for ASAM's rules and proved by reading it back."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, tostring

import defusedxml.ElementTree
import numpy as np

from cavmarl.core.errors import MapError
from cavmarl.maps.exports.opendrive_curves import mend_curves
from cavmarl.maps.netconvert import OPENDRIVE_OPTIONS
from cavmarl.maps.netconvert_process import run_netconvert, sumo_home
from cavmarl.maps.provenance import read_provenance
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network

_MINOR = "8"  # OpenDRIVE 1.8, whose rules ASAM's checker asks for
MOST_OFF = 0.02  # of the length of all roads
_CAR = 1 << VEHICLE_CLASSES.index("passenger")


@dataclass(frozen=True)
class RoundTrip:
    """What cars may use of a map, and of what netconvert makes of its export."""

    edges: tuple[int, int]  # of the map, of what was read back
    lanes: tuple[int, int]
    links: tuple[int, int]  # movements over junctions
    road_m: tuple[float, float]
    lane_m: tuple[float, float]

    @property
    def off(self) -> float:
        """How far the length of all roads is off, as a share."""
        return abs(self.road_m[1] / max(self.road_m[0], 1e-9) - 1.0)

    @property
    def same(self) -> bool:
        """Whether topology and lengths came back."""
        counts = (self.edges, self.lanes, self.links)
        return all(one == other for one, other in counts) and self.off <= MOST_OFF

    def to_dict(self) -> dict[str, Any]:
        return asdict(self) | {"off": self.off, "same": self.same}


def write_opendrive(source: Path, target: Path, timeout_s: float | None = None) -> RoundTrip:
    """Write a SUMO network as OpenDRIVE, and read that back.

    The target is written where what came back differs, too: the result says so.

    Raises:
        MapError: netconvert refuses the network or its own export, or the target cannot be written.
        MissingExtraError: netconvert is not installed.
    """
    network = read_network(source)
    types = str(sumo_home() / "data" / "typemap" / "opendriveNetconvert.typ.xml")
    try:
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".build-") as folder:
            draft, back = Path(folder) / "map.xodr", Path(folder) / "back.net.xml"
            words = ["--sumo-net-file", str(source), "--opendrive-output", str(draft)]
            run_netconvert(words, source, timeout_s)
            draft.write_bytes(_mended(draft, read_provenance(source)))
            words = ["--opendrive-files", str(draft), "-t", types, "-o", str(back)]
            run_netconvert([*words, *OPENDRIVE_OPTIONS], target, timeout_s)
            trip = _compared(network, read_network(back))
            os.replace(draft, target)
    except OSError as error:
        raise MapError(f"{target}: cannot be written ({error.strerror or error})") from error
    return trip


def _mended(draft: Path, facts: Mapping[str, str]) -> bytes:
    """The export by ASAM's rules, with what the map says of its origin, and without the date."""
    root: Element = defusedxml.ElementTree.fromstring(draft.read_bytes(), forbid_dtd=True)
    mend_curves(root)
    _join_controllers(root)
    for one in root.iter("object"):
        _mend_object(one)
    header = root.find("header")
    if header is not None:
        header.attrib.pop("date", None)
        header.set("revMinor", _MINOR)
        for key, value in facts.items():
            header.append(Element("userData", code=key, value=" ".join(value.split())))
    text: bytes = tostring(root, "utf-8")
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + text + b"\n"


def _mend_object(element: Element) -> None:
    """A crosswalk: its height, and its outline where 1.5 and later have it."""
    element.attrib.setdefault("zOffset", "0")
    outlines = element.findall("outline")
    if outlines:
        around = Element("outlines")
        for outline in outlines:
            element.remove(outline)
            around.append(outline)
        element.insert(0, around)


def _join_controllers(root: Element) -> None:
    """One controller a traffic light: netconvert writes one for each of its programs."""
    found: dict[str, Element] = {}
    for controller in root.findall("controller"):
        first = found.setdefault(controller.get("id", ""), controller)
        if first is controller:
            continue
        known = {control.get("signalId") for control in first}
        first.extend(one for one in controller if one.get("signalId") not in known)
        root.remove(controller)


def _compared(one: RoadNetwork, other: RoadNetwork) -> RoundTrip:
    mine, theirs = _Cars(one), _Cars(other)
    return RoundTrip(
        edges=(mine.edges, theirs.edges),
        lanes=(mine.lanes, theirs.lanes),
        links=(mine.links, theirs.links),
        road_m=(mine.road_m, theirs.road_m),
        lane_m=(mine.lane_m, theirs.lane_m),
    )


class _Cars:
    """What of a network cars may use: of the rest, netconvert's import leaves out some."""

    def __init__(self, network: RoadNetwork) -> None:
        cars = (network.lanes["permissions"] & _CAR != 0) & ~network.lanes["internal"]
        edges = np.unique(network.lanes["edge"][cars])
        links = network.links
        self.edges, self.lanes = len(edges), int(cars.sum())
        self.links = int((cars[links["from_lane"]] & cars[links["to_lane"]]).sum())
        self.road_m = float(network.edges["length_m"][edges].sum())
        self.lane_m = float(network.lanes["length_m"][cars].sum())
