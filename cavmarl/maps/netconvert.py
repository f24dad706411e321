"""Converts OpenStreetMap and OpenDRIVE to SUMO networks with netconvert (`eclipse-sumo` wheel).

The lanes of logged scenes are converted without netconvert, in `maps.scenes`.

The same source and options give the same bytes: netconvert's comment with the date is removed.

Each network file names its source (`maps.provenance`). This module also adds heights.
"""

from __future__ import annotations

import gzip
import hashlib
import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from cavmarl.core.atomic_file import draft_folder
from cavmarl.core.cache_folder import cache_dir
from cavmarl.core.errors import ConfigError, MapError, require
from cavmarl.core.scene_names import is_scene_file
from cavmarl.core.xml_root import is_sumo_config
from cavmarl.maps.heights.draping import HeightOptions, HeightReport, drape, raise_levels
from cavmarl.maps.map_kinds import MapKind, map_kind
from cavmarl.maps.net_document import NetDocument
from cavmarl.maps.netconvert_process import (
    MEMORY_LIMIT,
    TIME_LIMIT,
    BuildLog,
    Cures,
    quoted,
    run_netconvert,
    sumo_home,
)
from cavmarl.maps.opendrive_source import TYPE_MAP, OpenDriveSource
from cavmarl.maps.osm_roads import OsmRoads
from cavmarl.maps.osm_source import LANE_OPTIONS, prepare_osm
from cavmarl.maps.provenance import (
    NOT_STATED,
    NOTE_SEPARATOR,
    OSM_ATTRIBUTION,
    OSM_LICENCE,
    RoadDefaults,
    defaults_text,
    head_of,
    read_provenance,
    road_defaults,
)
from cavmarl.maps.scenes.scene_files import read_scene
from cavmarl.maps.scenes.scene_roads import scene_network
from cavmarl.maps.traffic_sides import NEAR_M, Side, sides_at
from cavmarl.roads.sumo_net.reader import map_name, read_network, source_hash
from cavmarl.roads.sumo_net.sumo_options import map_of_config
from cavmarl.roads.sumo_net.xml_source import read_bytes

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
    *LANE_OPTIONS,
    "--output.original-names",  # keeps OSM way ids of lanes, for bridges, names, defaults
)
OPENDRIVE_OPTIONS = ("--opendrive.import-all-lanes=false",)

_INPUT = {"sumo": "--sumo-net-file", "osm": "--osm-files", "opendrive": "--opendrive-files"}
_TYPE_MAP = {"osm": "osmNetconvert.typ.xml", "opendrive": "opendriveNetconvert.typ.xml"}
_OPTIONS: dict[MapKind, tuple[str, ...]] = {
    "sumo": (), "osm": OSM_OPTIONS, "opendrive": OPENDRIVE_OPTIONS, "scene": ()
}  # fmt: skip

_ISOLATED = "Removed a road without junctions"  # begins a warning
_TOLERANT = "--ignore-errors"
_LEFT_HAND = "--lefthand"
# Increase the number when sources are converted differently, so that cached maps are made again.
_CONVERSION = "conversion 2"
_SCENE_CONVERSION = "scene 2"  # the same for logged scenes

_COMMENT = re.compile(rb"<!-- generated on .*?-->\s*", re.DOTALL)
_FAR_M = 100_000.0  # farther from the origin, the projection distorts lengths

Origin = tuple[float, float]  # latitude and longitude, degrees
Told = Callable[[str], None]

STAGES = ("netconvert", "data of the source", "heights", "reading it back")


def _silent(stage: str) -> None:
    pass


@dataclass(frozen=True)
class BuildResult:
    """The result of a build."""

    path: Path  # the SUMO network
    source: Path  # the file from which it was built
    kind: MapKind  # kind of the source
    options: tuple[str, ...]  # netconvert's options; empty if a SUMO network was copied
    # how often each warning of netconvert occurred; in its text, names and numbers are `%`
    warnings: dict[str, int]
    # changes that netconvert reports: joined junctions, guessed roundabouts …
    corrections: tuple[str, ...]
    # with `tolerant`, ignored errors of netconvert; the named objects were left out
    dropped: tuple[str, ...]
    provenance: dict[str, str]  # where the map comes from, as written in its file
    defaults: tuple[RoadDefaults, ...] = ()  # values that the source lacks, from the type map
    notes: tuple[str, ...] = ()  # elements of the source that are not in the network, with counts
    heights: HeightReport | None = None
    levels: int = 0  # number of crossings of lanes on bridges or in tunnels; 0 with `heights`

    def to_dict(self) -> dict[str, Any]:
        return asdict(self) | {"path": str(self.path), "source": str(self.source)}


def build_network(
    source: str | Path,
    target: str | Path | None = None,
    *,
    options: Sequence[str] = (),
    bbox: Box | None = None,
    side: Side | None = None,
    origin: Origin | None = None,
    heights: HeightOptions | None = None,
    licences: tuple[str, str] = ("", ""),
    tolerant: bool = False,
    timeout_s: float | None = None,
    told: Told = _silent,
) -> BuildResult:
    """Make a SUMO network from a map file, and check that it can be read.

    Args:
        source: OpenStreetMap or OpenDRIVE, which netconvert converts to a network, or a SUMO
            network, which is copied, or a configuration of SUMO, which names a network. May be
            gzipped. Or a logged scene, whose lanes become a network.
        target: path of the network, gzipped if it ends in `.gz`. Default: in the cache, or the
            source itself if it needs no changes.
        options: additional options for netconvert.
        bbox: keep the roads within (min, min, max, max): longitude and latitude in degrees for
            OSM, otherwise metres in the source's own frame.
        side: side of the road on which vehicles drive; None: the side of the country (OSM), or the
            `rule` of the roads (OpenDRIVE). A SUMO network has its own side.
        origin: latitude and longitude of the map's x = y = 0, OSM only; by default the south-west
            corner of the roads' bounding box, in UTM.
        heights: terrain models for the roads; positions in the plane do not change. Without models,
            the ground is flat, and bridges and tunnels of OSM have heights where they cross roads.
        licences: licences of the source and of the terrain models; empty: the default.
        tolerant: let netconvert leave out objects that it cannot use instead of failing.
        timeout_s: time limit of netconvert; None: `CAVMARL_MAX_NETCONVERT_S`, or 600 s.
        told: called with each of `STAGES` as it begins.

    Raises:
        ConfigError: `bbox` is empty; the origin is not on the earth or too far from the map; `side`
            is given for a SUMO network; or any option is given for a logged scene.
        MapError: the source is broken, malicious or not a map; netconvert fails (its output is in
            the message); the result has no drivable lane; the heights cannot be used; the roads
            have no common traffic side; or the target cannot be written.
        MissingExtraError: netconvert, or a package for heights and levels, is not installed.
    """
    source = Path(source)
    if is_sumo_config(source):
        source = map_of_config(source)
    kind = map_kind(source)
    chosen = (*_OPTIONS[kind], *_crop(kind, bbox), *_centred(source, kind, origin), *options)
    if tolerant and chosen:
        chosen += (_TOLERANT,)
    if side is not None and kind == "sumo":
        raise ConfigError(
            f"--traffic-side {side}: {source} is a SUMO network, which has its own side "
            "(lefthand of <net>): remove the option, or build the network from its source again"
        )
    if kind == "scene" and (chosen or side is not None or heights is not None):
        raise ConfigError(
            f"{source} is a logged scene, which is converted as it is: leave out all options that "
            "change the map"
        )
    if target is None and not chosen and heights is None and kind != "scene":
        read_network(source)
        return BuildResult(source, source, kind, (), {}, (), (), read_provenance(source))
    place = Path(target) if target else _cache_entry(source, chosen, heights)
    made = _Build(
        source, kind, place, chosen, bbox, side, origin, heights, licences, timeout_s, told
    )
    try:
        made.run()
    except OSError as error:
        cure = "name another target" if target else "set CAVMARL_CACHE_DIR to another folder"
        raise MapError(f"{place}: cannot be written ({error.strerror or error}); {cure}") from error
    return BuildResult(
        path=place,
        source=source,
        kind=kind,
        options=made.options,
        warnings=made.log.warnings(),
        corrections=made.log.corrections(),
        dropped=made.log.errors(),
        provenance=read_provenance(place),
        defaults=made.defaults,
        notes=made.notes,
        heights=made.report,
        levels=made.levels,
    )


def map_file(path: str | Path) -> Path:
    """Return the SUMO network of a map file: the file itself, or a cached network built from it.

    For a configuration of SUMO, this is the network that it names.

    Raises MapError: see `build_network`.
    """
    path = Path(path)
    if is_sumo_config(path):
        path = map_of_config(path)
    if path.name.endswith((".net.xml", ".net.xml.gz")):
        return path
    kind = map_kind(path)
    if kind == "sumo":
        return path
    entry = _cache_entry(path, _OPTIONS[kind])
    if not entry.exists():
        build_network(path)
    return entry


def conversion_notes(path: Path) -> list[str]:
    """Return notes on the decisions, guesses and ignored elements of a map's conversion."""
    origin = read_provenance(path)
    if origin.get("traffic side", "").startswith("right"):
        del origin["traffic side"]  # the usual side
    told = ("traffic side", "defaults", "notes")
    return [f"{key}: {origin[key]}" for key in told if key in origin]


def _cache_entry(
    source: Path, options: Sequence[str], heights: HeightOptions | None = None
) -> Path:
    require("sumo", "sumo")
    words = [source_hash(source), version("eclipse-sumo"), _CONVERSION, *options]
    if is_scene_file(source.name):
        words += [_SCENE_CONVERSION, source.suffix]
    if heights is None:
        words.append("levels 4")  # version of the algorithm for bridges and tunnels
    else:
        words += [*map(source_hash, heights.models), repr(heights)]
    digest = hashlib.sha256("\0".join(words).encode())
    return cache_dir() / "maps" / digest.hexdigest()[:32] / f"{map_name(source)}.net.xml"


def _crop(kind: MapKind, bbox: Box | None) -> tuple[str, ...]:
    if bbox is None:
        return ()
    if not (bbox[0] < bbox[2] and bbox[1] < bbox[3]):
        raise ConfigError(f"bbox {bbox} is empty: give min x, min y, max x, max y")
    option = "--keep-edges.in-geo-boundary" if kind == "osm" else "--keep-edges.in-boundary"
    return (f"{option}={','.join(map(repr, bbox))}",)


def _centred(source: Path, kind: MapKind, origin: Origin | None) -> tuple[str, ...]:
    if origin is None:
        return ()
    latitude, longitude = origin
    if kind != "osm":
        raise ConfigError(
            f"--origin: {source} has its own frame: leave it out; only OpenStreetMap needs it"
        )
    if not (abs(latitude) < 90.0 and abs(longitude) <= 180.0):
        raise ConfigError(
            f"--origin {latitude:g},{longitude:g}: not a latitude and a longitude: give LAT,LON "
            "in degrees"
        )
    projection = f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +k=1 +x_0=0 +y_0=0"
    projection += " +datum=WGS84 +units=m +no_defs"
    return ("--proj", projection, "--offset.disable-normalization")


@dataclass
class _Build:
    source: Path
    kind: MapKind
    place: Path
    options: tuple[str, ...]
    bbox: Box | None
    side: Side | None
    origin: Origin | None
    heights: HeightOptions | None
    licences: tuple[str, str]
    timeout_s: float | None
    told: Told
    log: BuildLog = field(default_factory=BuildLog)
    defaults: tuple[RoadDefaults, ...] = ()
    notes: tuple[str, ...] = ()
    roads: OsmRoads | None = None  # roads of an OSM extract
    decided: str = ""  # the traffic side, and the reason for it
    report: HeightReport | None = None
    levels: int = 0

    def run(self) -> None:
        """Write the network to a folder beside the target, and move it when it is complete."""
        place = self.place
        if place.exists() and place.samefile(self.source):
            raise MapError(f"{place}: the target is the source: give another target")
        place.parent.mkdir(parents=True, exist_ok=True)
        cache = cache_dir() / "maps"  # one folder, so that any build removes drafts of killed ones
        with draft_folder(cache if place.is_relative_to(cache) else place.parent) as folder:
            draft = folder / f"{map_name(place)}.net.xml"
            self.told(STAGES[0])
            if self.kind == "scene":
                self._draw_scene(draft)
            elif self.options:
                self.log = self._convert(self._prepared(folder), draft)
            else:
                draft.write_bytes(read_bytes(self.source))
            content = self._finished(draft)
            draft.write_bytes(gzip.compress(content, mtime=0) if place.suffix == ".gz" else content)
            self.told(STAGES[3])
            _check_readable(self.source, draft, self.log)
            os.replace(draft, place)

    def _draw_scene(self, draft: Path) -> None:
        """Write the network of a logged scene."""
        scene = read_scene(self.source)
        try:
            drawn = scene_network(scene)
        except MapError as error:
            raise MapError(f"{self.source}: {error}") from error
        self.notes = (*scene.notes, *drawn.notes)
        draft.write_text(drawn.text, encoding="utf-8")

    def _prepared(self, folder: Path) -> Path:
        """Return the file for netconvert: the source, or a copy that netconvert can read."""
        if self.kind == "osm":
            self.roads = OsmRoads(self.source)
            self.roads.refuse_without_roads()
            self._drive_on(self.side or self._side_of_place(self.roads), "the place of its roads")
            copy = folder / "source.osm"
            left_hand = _LEFT_HAND in self.options
            self.notes = prepare_osm(self.source, self.roads, copy, left_hand)
            return copy if copy.exists() else self.source
        if self.kind != "opendrive":
            return self.source
        roads = OpenDriveSource(self.source, tolerant=_TOLERANT in self.options)
        self._drive_on(roads.use_side(self.side), "the rule of its roads")
        self.defaults, self.notes = roads.defaults, roads.notes()
        if not roads.changed:
            return self.source
        copy = folder / "source.xodr"
        copy.write_bytes(roads.content())
        return copy

    def _drive_on(self, side: Side, reason: str) -> None:
        self.decided = f"{side} (by {'option' if self.side else reason})"
        if side == "left" and _LEFT_HAND not in self.options:
            self.options += (_LEFT_HAND,)

    def _side_of_place(self, roads: OsmRoads) -> Side:
        """Return the traffic side of the country; raises MapError if it is ambiguous."""
        west, south, east, north = self.bbox or (-180.0, -90.0, 180.0, 90.0)
        ways = (way for way in roads.ways.values() if way.for_cars)
        nodes = {node for way in ways for node in way.nodes}
        places = [roads.places[node] for node in sorted(nodes & roads.places.keys())]
        inside = [(x, y) for x, y in places if west <= x <= east and south <= y <= north]
        sides = sides_at(inside or [(west, south), (east, north)])
        if len(sides) == 1:
            return sides.pop()
        problem = (
            "its roads are in places with left-hand and with right-hand traffic"
            if sides
            else f"all its roads are within {NEAR_M / 1e3:g} km of a border between left-hand and "
            "right-hand traffic"
        )
        raise MapError(
            f"{self.source}: {problem}: a network has one side; crop the map (--bbox), or choose "
            f"the side: cavmarl map build {self.source} --traffic-side left or right"
        )

    def _convert(self, prepared: Path, draft: Path) -> BuildLog:
        arguments = [_INPUT[self.kind], str(prepared), "-o", str(draft), *self.options]
        if self.kind in _TYPE_MAP:
            types = [sumo_home() / "data" / "typemap" / _TYPE_MAP[self.kind]]
            if self.kind == "opendrive":
                types.append(draft.with_name("lanes.typ.xml"))
                types[-1].write_bytes(TYPE_MAP)
            arguments += ["-t", ",".join(map(str, types))]
        cures = Cures(
            f"crop the map (cavmarl map build {self.source} --bbox …) or allow more time "
            f"(--timeout-s, or {TIME_LIMIT})",
            f"crop the map (cavmarl map build {self.source} --bbox …) or allow more memory "
            f"({MEMORY_LIMIT}, in bytes)",
            "keep an area with roads: --bbox WEST,SOUTH,EAST,NORTH, "
            + ("in degrees" if self.kind == "osm" else "in metres")
            if self.bbox is not None
            else "repair the source"
            if _TOLERANT in self.options
            else "repair the source, or drop its broken parts: "
            f"cavmarl map build {self.source} --tolerant",
        )
        return run_netconvert(arguments, self.source, self.timeout_s, cures)

    def _finished(self, draft: Path) -> bytes:
        """Return netconvert's output with the map's provenance and heights."""
        if not self.options and self.heights is None and self.kind != "scene":
            return draft.read_bytes()
        self.told(STAGES[1])
        roads = self.roads
        document = NetDocument(draft)
        _check_near(self.source, document, self.origin)
        if roads is not None:
            self.defaults = road_defaults(document, roads)
        if self.heights is not None:
            self.told(STAGES[2])
            self.report = drape(document, self.heights, roads, self.source)
        elif roads is not None:
            self.levels = raise_levels(document, roads, self.source)
        if self.report is not None or self.levels:
            return document.content(head_of(self._facts(document)))
        facts = head_of(self._facts(document))
        content = _COMMENT.sub(b"", draft.read_bytes(), count=1)
        return content.replace(b"<net ", facts + b"<net ", 1)

    def _facts(self, document: NetDocument) -> dict[str, str]:
        """Return the provenance of the map, to be written into its file."""
        facts = read_provenance(self.source) if self.kind == "sumo" else {}
        if not facts:
            facts = {"source": self.source.name, "source sha256": source_hash(self.source)}
            facts["licence"] = self.licences[0] or (
                OSM_LICENCE if self.kind == "osm" else NOT_STATED
            )
            if self.kind == "osm":
                facts["attribution"] = OSM_ATTRIBUTION
        if document.geo is not None:
            offset = f"{document.geo.offset_x_m:.2f},{document.geo.offset_y_m:.2f} m"
            facts |= {"projection": document.geo.projection, "offset": offset}
        if self.origin is not None:
            facts["origin"] = f"latitude {self.origin[0]!r}, longitude {self.origin[1]!r}"
        if self.decided:
            facts["traffic side"] = self.decided
        if self.defaults:
            facts["defaults"] = defaults_text(
                self.defaults, "edges" if self.kind == "osm" else "roads"
            )
        if self.notes:
            facts["notes"] = NOTE_SEPARATOR.join(self.notes)
        if self.levels:
            facts["levels"] = f"{self.levels} crossings of lanes on bridges and in tunnels"
        if self.heights is not None and self.report is not None:
            sums = [f"{path.name} (sha256 {source_hash(path)})" for path in self.heights.models]
            facts["heights"] = ", ".join(sums)
            facts["heights licence"] = self.licences[1] or NOT_STATED
            facts["heights filled"] = f"{self.report.filled_places} of {self.report.places} places"
        return facts


def _check_near(source: Path, document: NetDocument, origin: Origin | None) -> None:
    location = document.root.find("location")
    if origin is None or location is None:
        return
    corners = [float(word) for word in location.get("convBoundary", "0").split(",")]
    if max(map(abs, corners)) > _FAR_M or not all(map(math.isfinite, corners)):
        raise ConfigError(
            f"--origin {origin[0]:g},{origin[1]:g}: {source} is more than {_FAR_M / 1e3:g} km "
            "away: give LAT,LON in this order, near the roads"
        )


def _check_readable(source: Path, draft: Path, log: BuildLog) -> None:
    try:
        read_network(draft)
    except MapError as error:
        if any(text.startswith(_ISOLATED) for text in log.warnings()):
            raise MapError(
                f"{source}: no two roads for cars meet, and netconvert removes a road without "
                "junctions: export a larger area, in which streets cross"
            ) from error
        message = f"{source}: {str(error).removeprefix(f'{draft}: ')}"
        reported = (*log.errors(), *log.warnings())
        if reported:
            message += f"\nnetconvert reported:\n{quoted(reported)}"
        raise MapError(message) from error
