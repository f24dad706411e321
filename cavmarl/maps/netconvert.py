"""OpenStreetMap and OpenDRIVE made into SUMO networks by netconvert of the `eclipse-sumo` wheel.

The same source and options give the same bytes: netconvert's comment with the date is dropped.

The kind of a map file is told by its content and not by its name.
"""

from __future__ import annotations

import gzip
import hashlib
import os
import re
import shutil
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal
from xml.sax import SAXParseException
from xml.sax.handler import ContentHandler

from cavmarl.core.cache_folder import cache_dir
from cavmarl.core.errors import ConfigError, MapError, require
from cavmarl.core.processes import dying_with_parent
from cavmarl.roads.sumo_net.reader import map_name, read_network, source_hash
from cavmarl.roads.sumo_net.xml_source import read_bytes, read_xml

MapKind = Literal["sumo", "osm", "opendrive"]

MAP_ENDINGS = (".net.xml", ".net.xml.gz", ".osm", ".osm.gz", ".osm.xml", ".osm.xml.gz", ".xodr")

_KINDS = (
    "give a SUMO network (<net>, .net.xml), an OpenStreetMap extract (<osm>, .osm or .osm.xml) or "
    "an OpenDRIVE file (<OpenDRIVE>, .xodr); the first two also gzipped (.gz)"
)
_ROOTS: dict[str, MapKind] = {"net": "sumo", "osm": "osm", "OpenDRIVE": "opendrive"}


class _Root(ContentHandler):
    """Remembers the root element; the parser around it finds what is broken or hostile."""

    def __init__(self) -> None:
        super().__init__()
        self.name = ""

    def startElement(self, name: str, attrs: Any) -> None:
        self.name = self.name or name


def map_kind(path: Path) -> MapKind:
    """Read a map file to its end and tell its kind by its root element.

    Raises MapError: the file cannot be read, is broken or hostile XML, or is no map.
    """
    root = _Root()
    try:
        read_xml(path, root)
    except MapError as error:
        no_xml = isinstance(error.__cause__, SAXParseException) and not root.name
        if no_xml and not path.name.endswith(MAP_ENDINGS):
            raise MapError(f"{path}: is no map: {_KINDS}") from error
        raise
    if root.name not in _ROOTS:
        raise MapError(f"{path}: <{root.name}> is the root of no map: {_KINDS}")
    return _ROOTS[root.name]


_QUOTED = re.compile(r"'[^']*'")
_NUMBERED = re.compile(r"\S*\d\S*")
_CORRECTION = re.compile(r"^(Joined|Guessed|Removed) |^[1-9]\d* .*(removed|computed|split|added)$")


class BuildLog:
    """The output of one run with `--verbose` and without aggregated warnings."""

    def __init__(self, stdout: str = "", stderr: str = "") -> None:
        self._said = stdout.splitlines()
        self._complained = stderr.splitlines()

    def errors(self) -> tuple[str, ...]:
        return self._after("Error: ")

    def warnings(self) -> dict[str, int]:
        """How often each warning came, by its text with `%` for names and numbers."""
        kinds = Counter(
            _NUMBERED.sub("%", _QUOTED.sub("'%'", line)) for line in self._after("Warning: ")
        )
        return dict(kinds.most_common())

    def corrections(self) -> tuple[str, ...]:
        """What netconvert changed on its own account, in its words."""
        lines = (line.strip().rstrip(".") for line in self._said if line.startswith(" "))
        return tuple(line for line in lines if _CORRECTION.search(line))

    def complaint(self) -> tuple[str, ...]:
        """The errors or, if it died without one, all that it complained about."""
        return self.errors() or tuple(self._complained) or ("no message",)

    def _after(self, prefix: str) -> tuple[str, ...]:
        return tuple(
            line.removeprefix(prefix) for line in self._complained if line.startswith(prefix)
        )


Box = tuple[float, float, float, float]

OSM_OPTIONS = (
    "--geometry.remove",
    "--ramps.guess",
    "--junctions.join",
    "--tls.guess-signals",
    "--tls.discard-simple",
    "--tls.join",
    "--keep-edges.by-vclass=passenger",
    "--remove-edges.isolated",
)
OPENDRIVE_OPTIONS = ("--opendrive.import-all-lanes=false",)

_INPUT = {"sumo": "--sumo-net-file", "osm": "--osm-files", "opendrive": "--opendrive-files"}
_TYPE_MAP = {"osm": "osmNetconvert.typ.xml", "opendrive": "opendriveNetconvert.typ.xml"}
_OPTIONS = {"sumo": (), "osm": OSM_OPTIONS, "opendrive": OPENDRIVE_OPTIONS}

_COMMENT = re.compile(rb"<!-- generated on .*?-->\s*", re.DOTALL)
_SHOWN_LINES = 10
_LEFT_S = 86_400.0  # a build that is older than this was killed


@dataclass(frozen=True)
class BuildResult:
    """What a build did."""

    path: Path  # the SUMO network
    source: Path  # the file it was made from
    kind: MapKind  # of the source
    options: tuple[str, ...]  # netconvert's options; empty where a SUMO network was taken as it is
    # netconvert's warnings, counted by their text without names and numbers
    warnings: dict[str, int]
    # what netconvert says it changed: junctions joined, roundabouts guessed …
    corrections: tuple[str, ...]
    # with `tolerant`, the errors that netconvert ignored: what they name was left out
    dropped: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        return asdict(self) | {"path": str(self.path), "source": str(self.source)}


def build_network(
    source: str | Path,
    target: str | Path | None = None,
    *,
    options: Sequence[str] = (),
    bbox: Box | None = None,
    tolerant: bool = False,
    timeout_s: float = 600.0,
) -> BuildResult:
    """Make a SUMO network of a map file and prove that it can be read.

    Args:
        source: OpenStreetMap or OpenDRIVE, which netconvert turns into a network, or a SUMO
            network, which is taken as it is. Plain or gzipped.
        target: where the network goes, gzipped if it ends in `.gz`. By default the cache, or the
            source itself where nothing has to be done.
        options: more options for netconvert.
        bbox: keep the roads within (min, min, max, max): longitude and latitude in degrees for
            OSM, else metres in the source's own frame.
        tolerant: let netconvert leave out what it cannot use instead of giving up.
        timeout_s: how long netconvert may take.

    Raises:
        ConfigError: an empty `bbox`.
        MapError: the source is broken, hostile or no map, netconvert refuses it (its own lines are
            in the message), nothing in the result can be driven, or the target cannot be written.
        MissingExtraError: netconvert is needed and not installed.
    """
    source = Path(source)
    kind = map_kind(source)
    chosen = (*_OPTIONS[kind], *_crop(kind, bbox), *options)
    if tolerant and chosen:
        chosen += ("--ignore-errors",)
    log = BuildLog()
    if target is None and not chosen:
        read_network(source)
        place = source
    else:
        place = _cache_entry(source, chosen) if target is None else Path(target)
        try:
            log = _build(kind, source, place, chosen, timeout_s)
        except OSError as error:
            cure = "name another target" if target else "set CAVMARL_CACHE_DIR to another folder"
            raise MapError(
                f"{place}: cannot be written ({error.strerror or error}); {cure}"
            ) from error
    return BuildResult(
        path=place,
        source=source,
        kind=kind,
        options=chosen,
        warnings=log.warnings(),
        corrections=log.corrections(),
        dropped=log.errors(),
    )


def map_file(path: str | Path) -> Path:
    """The SUMO network of any map file: the file itself, or what netconvert once made of it.

    Raises MapError: see `build_network`.
    """
    path = Path(path)
    if path.name.endswith((".net.xml", ".net.xml.gz")):
        return path
    kind = map_kind(path)
    if kind == "sumo":
        return path
    entry = _cache_entry(path, _OPTIONS[kind])
    return entry if entry.exists() else build_network(path).path


def _cache_entry(source: Path, options: Sequence[str]) -> Path:
    require("sumo", "sumo")
    release = version("eclipse-sumo")
    digest = hashlib.sha256("\0".join([source_hash(source), release, *options]).encode())
    return cache_dir() / "maps" / digest.hexdigest()[:32] / f"{map_name(source)}.net.xml"


def _crop(kind: MapKind, bbox: Box | None) -> tuple[str, ...]:
    if bbox is None:
        return ()
    if not (bbox[0] < bbox[2] and bbox[1] < bbox[3]):
        raise ConfigError(f"bbox {bbox} is empty: give min x, min y, max x, max y")
    option = "--keep-edges.in-geo-boundary" if kind == "osm" else "--keep-edges.in-boundary"
    return (f"{option}={','.join(map(repr, bbox))}",)


def _build(
    kind: MapKind, source: Path, place: Path, options: Sequence[str], timeout_s: float
) -> BuildLog:
    if place.exists() and place.samefile(source):
        raise MapError(f"{place}: the target is the source: give another target")
    place.parent.mkdir(parents=True, exist_ok=True)
    for left in place.parent.glob(".build-*"):  # by a process that was killed
        if time.time() - left.stat().st_mtime > _LEFT_S:
            shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=place.parent, prefix=".build-") as folder:
        draft = Path(folder) / f"{map_name(place)}.net.xml"
        log = BuildLog()
        if options:
            log = _run(kind, source, draft, options, timeout_s)
            content = _COMMENT.sub(b"", draft.read_bytes(), count=1)
        else:
            content = read_bytes(source)
        draft.write_bytes(gzip.compress(content, mtime=0) if place.suffix == ".gz" else content)
        _check_readable(source, draft, log)
        os.replace(draft, place)
    return log


def _run(
    kind: MapKind, source: Path, draft: Path, options: Sequence[str], timeout_s: float
) -> BuildLog:
    """Run netconvert.

    Raises MapError: it fails or takes too long.
    """
    home = Path(require("sumo", "sumo").SUMO_HOME)
    command = [str(home / "bin" / "netconvert"), _INPUT[kind], str(source), "-o", str(draft)]
    if kind in _TYPE_MAP:
        command += ["-t", str(home / "data" / "typemap" / _TYPE_MAP[kind])]
    command += [*options, "--verbose", "--aggregate-warnings=1000000", "--xml-validation=never"]
    projections = str(home / "data" / "proj")
    own = {"SUMO_HOME": str(home), "PROJ_DATA": projections, "PROJ_LIB": projections}
    try:
        done = subprocess.run(
            dying_with_parent(command),
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
            env=os.environ | own,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise MapError(
            f"{source}: netconvert took longer than {timeout_s:g} s: crop the map "
            f"(cavmarl map build {source} --bbox …) or allow more time (--timeout-s)"
        ) from error
    log = BuildLog(done.stdout, done.stderr)
    if done.returncode != 0 or not draft.exists():
        tolerant = "--ignore-errors" in options
        cure = "mend the source"
        if not tolerant:
            cure += f", or leave out what is broken: cavmarl map build {source} --tolerant"
        raise MapError(
            f"{source}: netconvert gave up (exit code {done.returncode}):\n"
            f"{_quote(log.complaint())}\nCure: {cure}"
        )
    return log


def _check_readable(source: Path, draft: Path, log: BuildLog) -> None:
    try:
        read_network(draft)
    except MapError as error:
        message = f"{source}: {str(error).removeprefix(f'{draft}: ')}"
        said = (*log.errors(), *log.warnings())
        if said:
            message += f"\nnetconvert said:\n{_quote(said)}"
        raise MapError(message) from error


def _quote(lines: Sequence[str]) -> str:
    shown = [f"  {line}" for line in lines[:_SHOWN_LINES]]
    if len(lines) > _SHOWN_LINES:
        shown.append(f"  … and {len(lines) - _SHOWN_LINES} more")
    return "\n".join(shown)
