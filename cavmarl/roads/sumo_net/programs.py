"""Signal programs in SUMO's XML: <tlLogic> with its phases, and <WAUT> timetables.

Networks and additional files have the same elements, so one reader reads both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.handler import ContentHandler

from cavmarl.core.errors import MapError
from cavmarl.roads.sumo_net.xml_source import read_xml

# Every signal has this program, in which the signal is off and the rules of right of way apply.
OFF = "off"
UNNAMED = "<unknown>"  # SUMO's name of a program without programID

_REQUIRED = {
    "tlLogic": ("id",),
    "phase": ("duration", "state"),
    "WAUT": ("id", "startProg"),
    "wautSwitch": ("time", "to"),
    "wautJunction": ("wautID", "junctionID"),
}


@dataclass(frozen=True)
class ProgramPhase:
    """A <phase> of a program."""

    duration_s: float  # as in the file; SUMO's defaults replace missing values
    min_s: float
    max_s: float
    state: str  # one letter for every link of the signal
    # indices of phases that may follow; empty: the next phase
    following: tuple[int, ...] = ()


@dataclass(frozen=True)
class SignalProgram:
    """A signal program, <tlLogic>."""

    signal_id: str  # with `program_id`, the program's name
    program_id: str
    # SUMO's type: `static`, `actuated`, `delay_based`, `NEMA`, …; "": not stated
    kind: str
    offset_s: float  # delay of all phases
    place: str  # file and line, for error messages
    # phases in order; empty: the element only changes the offset of a known program
    phases: list[ProgramPhase] = field(default_factory=list)
    params: dict[str, str] = field(default_factory=dict)  # <param> by key


@dataclass(frozen=True)
class Timetable:
    """A timetable, <WAUT>: the times at which signals switch between programs."""

    start: str  # program at the beginning
    place: str  # file and line, for error messages
    # (seconds since the beginning, program), in the file's order
    switches: list[tuple[float, str]] = field(default_factory=list)
    signal_ids: list[str] = field(default_factory=list)  # the signals that follow this timetable


class ProgramReader:
    """Collects programs and timetables from the elements of a file.

    Args:
        path: path of the file, for error messages.
    """

    def __init__(self, path: Path) -> None:
        self.programs: list[SignalProgram] = []
        self.timetables: dict[str, Timetable] = {}
        self._path = path
        self._reference_s = 0.0
        self._program: SignalProgram | None = None
        self._timetable: Timetable | None = None

    def start(self, name: str, attrs: Mapping[str, str], line: int) -> None:
        """Process the start of an element; elements that do not concern signals are ignored.

        Raises MapError: an attribute is missing or not a number, or an element is misplaced.
        """
        place = f"{self._path}, line {line}: <{name}>"
        if missing := [key for key in _REQUIRED.get(name, ()) if key not in attrs]:
            raise MapError(f"{place} has no attribute '{missing[0]}': add it")
        if name == "tlLogic":
            self._open_program(attrs, place)
        elif name == "phase" and self._program is not None:
            self._program.phases.append(_phase(attrs, place))
        elif name == "param" and self._program is not None:
            self._program.params[attrs.get("key", "")] = attrs.get("value", "")
        elif name == "WAUT":
            self._reference_s = _seconds(attrs, "refTime", place, 0.0)
            self._timetable = Timetable(attrs["startProg"], place)
            self.timetables[attrs["id"]] = self._timetable
        elif name == "wautSwitch" and self._timetable is not None:
            time = self._reference_s + _seconds(attrs, "time", place)
            self._timetable.switches.append((time, attrs["to"]))
        elif name == "wautJunction":
            if attrs["wautID"] not in self.timetables:
                raise MapError(f"{place} names the unknown WAUT '{attrs['wautID']}': define it")
            self.timetables[attrs["wautID"]].signal_ids.append(attrs["junctionID"])

    def end(self, name: str) -> None:
        if name == "tlLogic":
            self._program = None
        elif name == "WAUT":
            self._timetable = None

    def _open_program(self, attrs: Mapping[str, str], place: str) -> None:
        offset = 0.0 if attrs.get("offset") == "begin" else _seconds(attrs, "offset", place, 0.0)
        program_id, kind = attrs.get("programID", UNNAMED), attrs.get("type", "")
        if not (attrs["id"] and program_id):
            raise MapError(f"{place} has an empty id or programID: give it a name")
        self._program = SignalProgram(attrs["id"], program_id, kind, offset, place)
        self.programs.append(self._program)


def read_programs(path: Path) -> ProgramReader:
    """Read the signal programs and timetables of an additional file (`.add.xml`, also gzipped).

    Raises MapError: the XML is malicious or broken, or has an invalid element.
    """
    handler = _AdditionalHandler(path)
    read_xml(path, handler)
    return handler.reader


class _AdditionalHandler(ContentHandler):
    def __init__(self, path: Path) -> None:
        super().__init__()
        self.reader = ProgramReader(path)
        self._locator: Any = None

    def startElement(self, name: str, attrs: Any) -> None:
        self.reader.start(name, attrs, self._locator.getLineNumber())

    def endElement(self, name: str) -> None:
        self.reader.end(name)


def _phase(attrs: Mapping[str, str], place: str) -> ProgramPhase:
    duration = _seconds(attrs, "duration", place)
    # As in SUMO, the maximum duration is unlimited if only the minimum is given.
    longest = math.inf if "minDur" in attrs else duration
    try:
        following = tuple(int(number) for number in attrs.get("next", "").split())
    except ValueError as error:
        raise MapError(
            f"{place} has next='{attrs['next']}': write phase numbers, separated by spaces"
        ) from error
    return ProgramPhase(
        duration,
        _seconds(attrs, "minDur", place, duration),
        _seconds(attrs, "maxDur", place, longest),
        attrs["state"],
        following,
    )


def _seconds(attrs: Mapping[str, str], key: str, place: str, default: float | None = None) -> float:
    if key not in attrs and default is not None:
        return default
    text = attrs[key]
    try:
        value = _clock(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise MapError(f"{place} has {key}='{text}': must be a finite number of seconds; repair it")
    return value


def _clock(text: str) -> float:
    """Return seconds from SUMO's formats: `90`, `00:01:30`, or `1:00:00:00` with days."""
    parts = [float(part) for part in text.split(":")]
    if len(parts) not in (1, 3, 4):
        raise ValueError(text)
    days, hours, minutes, seconds = [0.0] * (4 - len(parts)) + parts
    return ((days * 24.0 + hours) * 60.0 + minutes) * 60.0 + seconds
