"""The input of SUMO: a map, demand files, and the options of a `.sumocfg` that change traffic.

This module also makes SUMO's command line, which is the same wherever SUMO is run.
"""

from __future__ import annotations

import gzip
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, tostring

import defusedxml.ElementTree
from defusedxml.common import DefusedXmlException

from cavmarl.core.errors import ConfigError, DemandError, SumoError, require
from cavmarl.core.xml_root import is_sumo_config
from cavmarl.roads.sumo_net.sumo_options import files_of, known_options, read_options
from cavmarl.roads.sumo_net.xml_source import declared_encoding, read_bytes, read_tree
from cavmarl.traffic.demand.element import DemandReport, late_begin, parse_time_ms
from cavmarl.traffic.demand.element import Element as DemandElement
from cavmarl.traffic.demand.sumo_config import tell_ignored
from cavmarl.traffic.demand.xml_files import read_elements

_PERSONS = ("person", "personFlow")
_OFF_ROAD = (*_PERSONS, "container", "containerFlow")
_ONLY = "moves in SUMO only"
_PERSONS_CURE = "; traffic.source = sumo-traffic mirrors persons, with sumo.max_persons above 0"
_BEGINS = {"vehicle": "depart", "trip": "depart", "flow": "begin"}  # attribute of departure
# Kinds of options that are passed to SUMO.
_PASSED = ("read", "traffic", "beyond")
# SUMO writes no output for a file without these words; a character reference may hide a word.
_MAY_WRITE = re.compile(rb"\bfile\b|dest|output|&#|include", re.IGNORECASE)
_COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)
_ELSEWHERE = re.compile(r",|\$\{")  # a comma separates files; ${ begins an environment variable
_READ_FILES = {"rerouter", "variableSpeedSign"}  # elements whose `file` SUMO reads
_NOWHERE = "NUL"  # SUMO's name of the null device
_ASCII_BELOW = {"utf-8", "utf8", "ascii", "us-ascii", "iso-8859-1", "latin-1", "windows-1252"}


@dataclass(frozen=True)
class SumoInput:
    """Demand files and options for SUMO."""

    route_files: tuple[Path, ...]  # demand that SUMO reads during the run
    additional_files: tuple[Path, ...]  # types, stops, signal programs; read first
    begin_s: float = 0.0  # begin of the demand
    has_begin: bool = False  # whether the configuration states the begin
    # options of the configuration that change traffic
    options: dict[str, str] = field(default_factory=dict)
    net_file: Path | None = None  # the map named by the configuration
    tolerated: tuple[str, ...] = ()  # ignored options, one per line


def read_input(demand: Sequence[Path]) -> SumoInput:
    """Sort demand files by their kind.

    Args:
        demand: one configuration of SUMO, or files of routes, trips and flows and additional files.

    Raises:
        ConfigError: there is no file, a file cannot be read, or a file is not demand.
    """
    if not demand:
        raise ConfigError("no demand: give --demand FILE (.rou.xml, .add.xml or .sumocfg)")
    if len(demand) == 1 and is_sumo_config(demand[0]):
        return _read_config(demand[0])
    routes, additional = [], []
    for path in demand:
        root = _root_tag(path)
        if root in ("routes", "trips", "flows", "vtypes", "vTypes"):
            routes.append(path.resolve())
        elif root in ("additional", "add", "tlLogics"):
            additional.append(path.resolve())
        else:
            raise ConfigError(
                f"{path}: <{root}> is not demand; give files of <routes> or <additional>, or one "
                ".sumocfg alone"
            )
    return SumoInput(tuple(routes), tuple(additional))


def begun(given: SumoInput, horizon_s: float) -> SumoInput:
    """Return the input, with a later begin if no vehicle departs within an episode.

    See `DemandFile.begun`. Files that cannot be read are skipped: SUMO reports the error.
    """
    firsts: list[tuple[int, str]] = []
    begin_ms = round(1000.0 * given.begin_s)

    def take(element: DemandElement) -> None:
        if element.name in _BEGINS:
            time_ms = parse_time_ms(element.attrs.get(_BEGINS[element.name], "0"))
            firsts.append((begin_ms if time_ms is None else time_ms, element.place))

    with suppress(DemandError):
        for path in (*given.route_files, *given.additional_files):
            read_elements(path, DemandReport(), take)
    first_ms, place = min(firsts, default=(begin_ms, ""))
    if first_ms < begin_ms + 1000.0 * horizon_s:
        return given
    report = DemandReport()
    report.tolerate(late_begin(given.begin_s, horizon_s, first_ms, given.has_begin), place)
    begin_s = given.begin_s if given.has_begin else float(first_ms // 1000)
    return replace(given, begin_s=begin_s, tolerated=(*given.tolerated, *report.lines()))


def read_unmirrored(
    given: SumoInput, off_road: Mapping[str, str], most_persons: int
) -> tuple[list[str], bool]:
    """Return lines that count what moves only in SUMO, and whether there are persons.

    `off_road`: vehicle classes of types that do not use roads, by name. `most_persons`: number of
    persons that a world mirrors. Files that cannot be read count as files with persons; SUMO
    reports the error.
    """
    skipped, found, is_read = DemandReport(), DemandReport(), False

    def take(element: DemandElement) -> None:
        vclass = off_road.get(element.attrs.get("type", ""), "")
        if element.name in _BEGINS and vclass:
            found.tolerate(f"<{element.name}> of class {vclass} {_ONLY}", element.place)

    with suppress(DemandError):
        for path in (*given.route_files, *given.additional_files):
            read_elements(path, skipped, take)
        is_read = True
    tallies = {name: skipped.tolerated.get(f"<{name}> is not read") for name in _OFF_ROAD}
    for name, tally in tallies.items():
        is_person = name in _PERSONS
        if tally is not None and not (is_person and most_persons):
            cure = _PERSONS_CURE if is_person else ""
            found.tolerate(f"<{name}> {_ONLY}{cure}", tally.first, tally.count)
    return found.lines(), not is_read or any(tallies[name] is not None for name in _PERSONS)


def without_outputs(path: Path, folder: Path) -> Path:
    """Return a map or demand file without SUMO outputs: itself, or a copy in `folder`.

    Raises:
        ConfigError: the file includes another file, its encoding cannot be searched, or SUMO would
            read its name as the name of another file.
    """
    if found := _ELSEWHERE.search(str(path)):
        raise ConfigError(
            f"{path}: SUMO reads a name with {found[0]!r} as another file's name; rename the file"
        )
    if not _may_write(path, path.stat().st_mtime_ns):
        return path
    root = _root(path)
    changes = [_silence(element, path) for element in root.iter()]
    if not any(changes):
        return path
    copy = folder / f"{len(list(folder.iterdir()))}_{path.name.removesuffix('.gz')}"
    copy.write_bytes(tostring(root, encoding="utf-8", xml_declaration=True))
    return copy


@lru_cache(maxsize=64)  # SUMO is started for each episode
def _may_write(path: Path, changed_ns: int) -> bool:
    content = read_bytes(path)
    encoding = declared_encoding(content).lower() or "utf-8"
    if encoding not in _ASCII_BELOW or 0 in content[:4]:  # zero bytes: UTF-16 or UTF-32
        raise ConfigError(f"{path}: encoded as {encoding} or UTF-16; save it as UTF-8")
    if b"<![CDATA[" not in content:  # CDATA may contain text that looks like a comment
        content = _COMMENT.sub(b"", content)  # netconvert writes its options to a comment
    return bool(_MAY_WRITE.search(content))


def _silence(element: Element, path: Path) -> bool:
    """Redirect the outputs that an element requests; return whether it requests any."""
    if element.tag == "include":
        raise ConfigError(f"{path}: <include> is not supported; put the content into the file")
    changes = {}
    for name, value in element.attrib.items():
        if name == "file" and element.tag in _READ_FILES:
            changes[name] = str((path.parent / value).resolve())
        elif name in ("file", "dest", "output"):
            changes[name] = _NOWHERE
    key = element.get("key", "")
    if element.tag == "param" and (key == "file" or key.endswith(".file") or "output" in key):
        changes["value"] = _NOWHERE
    element.attrib.update(changes)
    return bool(changes)


def _read_config(path: Path) -> SumoInput:
    given = read_options(path, ConfigError)
    report = DemandReport()
    tell_ignored(path, given, report, ("time", "seed", "unread"))
    begin = given["begin"].value if "begin" in given else "0"
    begin_ms = parse_time_ms(begin)
    if begin_ms is None:
        raise ConfigError(
            f"{path}: begin = '{begin}' is not a time; give seconds or hours:minutes:seconds"
        )
    return SumoInput(
        route_files=_resolved(files_of(path, given, ["route-files"], ConfigError)),
        additional_files=_resolved(files_of(path, given, ["additional-files"], ConfigError)),
        begin_s=begin_ms / 1000.0,
        has_begin="begin" in given,
        options={
            name: option.value
            for name, option in given.items()
            if name == "end" or known_options()[name].kind in _PASSED
        },
        net_file=next(iter(_resolved(files_of(path, given, ["net-file"], ConfigError))), None),
        tolerated=tuple(report.lines()),
    )


def _resolved(files: Iterable[Path]) -> tuple[Path, ...]:
    return tuple(file.resolve() for file in files)


def _root(path: Path) -> Element:
    with _readable(path):
        return read_tree(path)


def _root_tag(path: Path) -> str:
    """Return the root tag without reading the rest, because demand of a day is long."""
    with _readable(path):
        content = BytesIO(read_bytes(path))
        _, root = next(defusedxml.ElementTree.iterparse(content, ("start",), forbid_dtd=True))
    return str(root.tag)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Convert errors of reading a file into a ConfigError that names the file."""
    try:
        yield
    except ParseError as error:
        raise ConfigError(f"{path}, line {error.position[0]}: broken XML ({error})") from error
    except DefusedXmlException as error:
        raise ConfigError(f"{path}: declares a document type or entities; remove them") from error
    except (ValueError, LookupError) as error:
        raise ConfigError(f"{path}: cannot be decoded ({error}); save it as UTF-8") from error
    except (gzip.BadGzipFile, EOFError) as error:
        raise ConfigError(f"{path}: broken gzip ({error}); make the file again") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from error


def command_words(
    map_file: Path,
    demand: SumoInput,
    folder: Path,
    dt_s: float,
    seed: int,
    more: dict[str, str] | None = None,
    additional: tuple[Path, ...] = (),
) -> list[str]:
    """Return the arguments of SUMO's command line.

    `map_file`: a SUMO network. `folder`: destination for copies of files without outputs. `seed`:
    seed of SUMO's random numbers. `more`: options that override the demand's configuration.
    `additional`: further additional files.
    """
    copies = folder / "additional"
    copies.mkdir(exist_ok=True)
    files = [str(without_outputs(path, copies)) for path in demand.additional_files]
    routes = [str(without_outputs(path, copies)) for path in demand.route_files]
    options = demand.options | {
        "net-file": str(without_outputs(map_file, copies)),
        "route-files": ",".join(routes),
        "additional-files": ",".join([*files, *map(str, additional)]),
        "begin": str(demand.begin_s),
        "step-length": repr(dt_s),
        "seed": str(seed),
        "no-step-log": "true",
        "no-warnings": "true",
        "duration-log.disable": "true",
        "xml-validation": "never",
        **(more or {}),
    }
    return [f"--{name}={value}" for name, value in options.items() if value]


def free_libsumo() -> object:
    """Return libsumo, in which no simulation runs in this process.

    Raises MissingExtraError: libsumo is not installed; SumoError: a simulation runs in it, which a
    second start would silently replace.
    """
    libsumo = require("libsumo", "sumo")
    if libsumo.isLoaded():
        raise SumoError(
            "libsumo allows one simulation per process, and another one runs in this process; "
            "close it, or start the new simulation in its own process"
        )
    return libsumo
