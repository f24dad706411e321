"""Exports OpenDRIVE with netconvert, repaired for ASAM's rules and verified by reading it back."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree.ElementTree import Element, tostring

import defusedxml.ElementTree

from cavmarl.core.atomic_file import draft_folder, write_whole
from cavmarl.core.cache_folder import cache_dir, report_unwritable
from cavmarl.core.errors import MapError
from cavmarl.maps.exports.opendrive_carla import fit_to_carla, origin_of
from cavmarl.maps.exports.opendrive_curves import mend_curves
from cavmarl.maps.exports.opendrive_trip import RoundTrip, roads_of_file, roads_of_map
from cavmarl.maps.netconvert import OPENDRIVE_OPTIONS
from cavmarl.maps.netconvert_process import run_netconvert, sumo_home
from cavmarl.maps.provenance import read_provenance
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network, source_hash

_HEAD = b'<?xml version="1.0" encoding="UTF-8"?>\n'
STAGES = ("reading", "netconvert writes", "ASAM's rules", "netconvert reads", "comparison")
_CARLA_FORMAT = 3  # increase this if `carla_document` returns another text for a map
_MINOR = "8"  # OpenDRIVE 1.8, which ASAM's checker verifies


def write_opendrive(
    source: Path,
    target: Path,
    timeout_s: float | None = None,
    told: Callable[[str], None] = lambda stage: None,
    for_carla: bool = False,
) -> RoundTrip:
    """Write a SUMO network as OpenDRIVE and read it back; call `told` at the start of each stage.

    If netconvert reads back another network, the target is still written, and the result reports
    the differences. With `for_carla`, `opendrive_carla.fit_to_carla` changes the file.

    Raises:
        MapError: netconvert refuses the network or its own export, or the target cannot be written.
        MissingExtraError: netconvert is not installed.
    """
    told(STAGES[0])
    network = read_network(source)
    types = str(sumo_home() / "data" / "typemap" / "opendriveNetconvert.typ.xml")
    try:
        with draft_folder(target.parent) as folder:
            draft, back = folder / "map.xodr", folder / "back.net.xml"
            told(STAGES[1])
            _convert(source, draft, timeout_s)
            told(STAGES[2])
            root = _mended(draft, read_provenance(source))
            if for_carla:
                fit_to_carla(root, origin_of(network))
            draft.write_bytes(_HEAD + tostring(root, "utf-8") + b"\n")
            words = ["--opendrive-files", str(draft), "-t", types, "-o", str(back)]
            told(STAGES[3])
            run_netconvert([*words, *OPENDRIVE_OPTIONS], target, timeout_s)
            told(STAGES[4])
            trip = RoundTrip(
                roads_of_map(network), roads_of_file(root), roads_of_map(read_network(back))
            )
            os.replace(draft, target)
    except OSError as error:
        raise MapError(f"{target}: cannot be written ({error.strerror or error})") from error
    return trip


def carla_document(source: Path, network: RoadNetwork) -> str:
    """Return a SUMO network as OpenDRIVE for CARLA's client, without reading it back.

    The document is kept in the cache folder. `network`: the map as read from `source`.

    Raises:
        MapError: netconvert refuses the network.
        MissingExtraError: netconvert is not installed.
    """
    kept = cache_dir() / "carla" / f"{source_hash(source)}-{_CARLA_FORMAT}.xodr"
    with suppress(OSError, UnicodeError):
        return kept.read_text(encoding="utf-8")
    with TemporaryDirectory() as folder:
        draft = Path(folder) / "map.xodr"
        _convert(source, draft, None)
        root = _mended(draft, read_provenance(source))
    fit_to_carla(root, origin_of(network))
    document: bytes = _HEAD + tostring(root, "utf-8") + b"\n"
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_whole(kept, document)
    except OSError as error:
        report_unwritable(error)
    return document.decode()


def _convert(source: Path, draft: Path, timeout_s: float | None) -> None:
    words = ["--sumo-net-file", str(source), "--opendrive-output", str(draft)]
    run_netconvert(words, source, timeout_s)


def _mended(draft: Path, facts: Mapping[str, str]) -> Element:
    """Return the export, repaired for ASAM's rules, with the map's origin and without the date."""
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
    return root


def _mend_object(element: Element) -> None:
    """Add the height of a crosswalk, and move its outline to where OpenDRIVE 1.5 expects it."""
    element.attrib.setdefault("zOffset", "0")
    outlines = element.findall("outline")
    if outlines:
        around = Element("outlines")
        for outline in outlines:
            element.remove(outline)
            around.append(outline)
        element.insert(0, around)


def _join_controllers(root: Element) -> None:
    """Merge the controllers of a traffic light: netconvert writes one for each program."""
    found: dict[str, Element] = {}
    for controller in root.findall("controller"):
        first = found.setdefault(controller.get("id", ""), controller)
        if first is controller:
            continue
        known = {control.get("signalId") for control in first}
        first.extend(one for one in controller if one.get("signalId") not in known)
        root.remove(controller)
