"""SUMO's configuration files: network, demand files and times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.handler import ContentHandler

from cavmarl.core.errors import DemandError
from cavmarl.roads.sumo_net.xml_source import read_xml
from cavmarl.traffic.demand.demand_records import CODES
from cavmarl.traffic.demand.element import Element
from cavmarl.traffic.demand.rerouting_device import DeviceOptions

_ROOTS = ("configuration", "sumoConfiguration")
_OPTIONS = {
    "n": "net-file",
    "net": "net-file",
    "r": "route-files",
    "a": "additional-files",
    "b": "begin",
    "e": "end",
}


@dataclass(frozen=True)
class SumoConfigFile:
    """The settings of a `.sumocfg` that concern network, demand and time."""

    net_file: Path | None  # the road network; None if the file names none
    files: tuple[Path, ...]  # additional files, then route files, in SUMO's order of reading
    begin_ms: int  # start of the simulation
    end_ms: int  # end of the simulation; -1: when the demand has ended
    step_ms: int  # length of a step
    rerouting: DeviceOptions  # options of the rerouting device
    departs: Mapping[str, str]  # departLane and departSpeed of vehicles without their own


class _Handler(ContentHandler):
    def __init__(self, path: Path) -> None:
        super().__init__()
        self.options: dict[str, Element] = {}
        self._path = path
        self._root = ""
        self._locator: Any = None

    def startElement(self, name: str, attrs: Any) -> None:
        element = Element(name, dict(attrs.items()), str(self._path), self._locator.getLineNumber())
        if not self._root:
            self._root = name
            if name not in _ROOTS:
                raise element.error(
                    "is not the root of a SUMO configuration", "give a file with <configuration>"
                )
        elif "value" in element.attrs or "v" in element.attrs:
            element.attrs = {"value": element.attrs.get("value", element.attrs.get("v", ""))}
            self.options[_OPTIONS.get(name, name)] = element


def read_sumo_config(path: Path) -> SumoConfigFile:
    """Read a `.sumocfg`.

    Raises DemandError: the file is missing, is no SUMO configuration, or has an invalid time.
    """
    handler = _Handler(path)
    read_xml(path, handler, DemandError)
    options = handler.options

    def paths(name: str) -> list[Path]:
        text = options[name].attrs["value"] if name in options else ""
        return [path.parent / part.strip() for part in text.split(",") if part.strip()]

    def time_ms(name: str, default: int) -> int:
        element = options.get(name)
        # SUMO writes -1 for no end.
        if element is None or element.attrs["value"].strip().startswith("-1"):
            return default
        return element.time_ms("value")

    net = paths("net-file")
    step_ms = time_ms("step-length", 1000)
    if step_ms <= 0:
        raise options["step-length"].error("is no valid step length", "write seconds above 0")
    return SumoConfigFile(
        net_file=net[0] if net else None,
        files=tuple(paths("additional-files") + paths("route-files")),
        begin_ms=time_ms("begin", 0),
        end_ms=time_ms("end", -1),
        step_ms=step_ms,
        rerouting=DeviceOptions.of(options),
        departs=_departs(options),
    )


def _departs(options: Mapping[str, Element]) -> dict[str, str]:
    """Return the attributes of departures that a configuration sets for all vehicles."""
    found = {}
    for key in ("departLane", "departSpeed"):
        element = options.get(f"default.{key.lower()}")
        if element is None:
            continue
        found[key] = element.attrs["value"].strip()
        if found[key] not in CODES[key]:
            element.number("value", 0.0, least=0.0, words=CODES[key])
    return found
