"""A SUMO network file as a tree, for changes without netconvert."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, tostring

import numpy as np
from defusedxml.common import DefusedXmlException
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.roads.network import GeoReference
from cavmarl.roads.sumo_net.xml_source import read_tree

Points = NDArray[np.float64]

_WAY = re.compile(r"-?(\d+)")
HEIGHT_DIGITS = 3


@dataclass(frozen=True)
class DocumentLane:
    """A lane of a network file."""

    edge: Element
    element: Element

    @property
    def id(self) -> str:
        return self.element.get("id", "")

    @property
    def internal(self) -> bool:
        return self.edge.get("function", "") != ""

    @cached_property
    def points(self) -> Points:
        """(n, 2) or (n, 3), as in the file."""
        return points_of(self.element)

    @property
    def ways(self) -> list[str]:
        """Ids of the OSM ways from which the lane was made."""
        for param in self.element.iter("param"):
            if param.get("key") == "origId":
                return param.get("value", "").split()
        named = _WAY.match(self.edge.get("id", ""))
        return [named[1]] if named else []


class NetDocument:
    """The elements of a network file."""

    def __init__(self, path: Path) -> None:
        """Read a file; raises MapError if it is not a network, or is broken."""
        self.path = path
        try:
            root = read_tree(path)
        except (ParseError, DefusedXmlException, ValueError, OSError) as error:
            raise MapError(f"{path}: cannot be read ({error}): build it again") from error
        if root.tag != "net":
            raise MapError(f"{path}: <{root.tag}> is not a SUMO network: give a .net.xml file")
        self.root = root
        self.lanes = [
            DocumentLane(edge, lane) for edge in root.iter("edge") for lane in edge.iter("lane")
        ]

    @cached_property
    def geo(self) -> GeoReference | None:
        location = self.root.find("location")
        if location is None or location.get("projParameter", "!") in ("!", "-", "."):
            return None
        return GeoReference(location.get("projParameter", ""), *self.offset_m)

    @property
    def offset_m(self) -> tuple[float, float]:
        """The offset that netconvert has added to the source's coordinates."""
        location = self.root.find("location")
        words = "0,0" if location is None else location.get("netOffset", "0,0")
        x, y = map(float, words.split(","))
        return x, y

    def junctions(self) -> Iterator[Element]:
        return self.root.iter("junction")

    def content(self, head: bytes = b"") -> bytes:
        """Return the file's bytes; `head` is a comment before the root."""
        text: bytes = tostring(self.root, "utf-8")
        return b'<?xml version="1.0" encoding="UTF-8"?>\n' + head + text + b"\n"


def points_of(element: Element) -> Points:
    """Return the `shape` of an element, (n, 2) or (n, 3); (0, 2) if it has none."""
    words = [word.split(",") for word in element.get("shape", "").split()]
    if not words:
        return np.zeros((0, 2))
    size = min(map(len, words))
    try:
        return np.array([word[:size] for word in words], dtype=np.float64)
    except ValueError as error:
        raise MapError(f"{element.get('id')}: shape='{element.get('shape')}': {error}") from error


def shape_text(plane: list[str], heights_m: Points) -> str:
    """Return a `shape`: positions in the plane, as written in the file, each with its height."""
    return " ".join(
        f"{place},{height:.{HEIGHT_DIGITS}f}"
        for place, height in zip(plane, heights_m.tolist(), strict=True)
    )
