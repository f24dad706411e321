"""The kind of a map file, determined from its content instead of its name."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal
from xml.sax import SAXParseException
from xml.sax.handler import ContentHandler

from cavmarl.core.errors import MapError
from cavmarl.core.scene_names import is_scene_file
from cavmarl.roads.sumo_net.xml_source import read_xml

MapKind = Literal["sumo", "osm", "opendrive", "scene"]

MAP_ENDINGS = (".net.xml", ".net.xml.gz", ".osm", ".osm.gz", ".osm.xml", ".osm.xml.gz", ".xodr")

_KINDS = (
    "give a SUMO network (<net>, .net.xml), an OpenStreetMap extract (<osm>, .osm or .osm.xml) or "
    "an OpenDRIVE file (<OpenDRIVE>, .xodr); the first two also gzipped (.gz); or a logged scene "
    "(.pkl of ScenarioNet, .json of GPUDrive)"
)
_ROOTS: dict[str, MapKind] = {"net": "sumo", "osm": "osm", "OpenDRIVE": "opendrive"}


class _Root(ContentHandler):
    """Stores the name of the root element; the parser reports broken or malicious XML."""

    def __init__(self) -> None:
        super().__init__()
        self.name = ""

    def startElement(self, name: str, attrs: Any) -> None:
        self.name = self.name or name


def map_kind(path: Path) -> MapKind:
    """Read a map file to its end, and return the kind of its root element.

    A logged scene is recognized by its suffix, and not read.

    Raises MapError: the file cannot be read, is broken or malicious XML, or is not a map.
    """
    if is_scene_file(path.name):
        return "scene"
    root = _Root()
    try:
        read_xml(path, root)
    except MapError as error:
        no_xml = isinstance(error.__cause__, SAXParseException) and not root.name
        if no_xml and not path.name.endswith(MAP_ENDINGS):
            raise MapError(f"{path}: not a map: {_KINDS}") from error
        raise
    if root.name not in _ROOTS:
        raise MapError(f"{path}: <{root.name}> is not the root of a map: {_KINDS}")
    return _ROOTS[root.name]
