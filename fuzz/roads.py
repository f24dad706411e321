"""Targets for roads: networks, signal programs, buildings, other maps, caches, zones."""

from __future__ import annotations

import gzip
from dataclasses import replace
from functools import cache
from pathlib import Path

import pyproj

from cavmarl.maps.buildings import with_buildings
from cavmarl.maps.netconvert import build_network
from cavmarl.roads.cache import _entry, load_network
from cavmarl.roads.network import GeoReference, RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network, source_hash
from cavmarl.roads.sumo_net.signal_plans import with_programs
from cavmarl.zones.partition.zone_file import read_zones, write_zones
from cavmarl.zones.partition.zone_layouts import cut_map
from cavmarl.zones.partition.zone_partition import ZonePartition
from fuzz.files import ROOT, Target, scratch, seed

__all__ = ["BUILDINGS", "CACHED", "MAPS", "NETWORKS", "PROGRAMS", "ZONES", "grid"]

NETCONVERT_S = 5.0  # a longer time is no crash, but slows the fuzzer


@cache
def grid() -> RoadNetwork:
    """Return the roads for reading programs and demand."""
    return load_network(ROOT / "envs" / "grid4x4" / "map" / "map.net.xml")


def _network(content: bytes) -> RoadNetwork:
    return read_network(scratch("small.net.xml", content))


def _networks() -> tuple[bytes, ...]:
    plain = seed("crossing.net.xml")
    return plain, gzip.compress(plain, mtime=0)


def _programs(content: bytes) -> RoadNetwork:
    return with_programs(grid(), [scratch("programs.add.xml", content)])


@cache
def _placed_grid() -> RoadNetwork:
    """Return the roads for reading buildings, at the position of the seeds."""
    projection = "+proj=utm +zone=32 +ellps=WGS84"
    x, y = pyproj.Proj(projparams=projection)(11.0, 49.0)
    return replace(grid(), geo=GeoReference(projection, -x, -y))


def _buildings(content: bytes) -> RoadNetwork:
    return with_buildings(_placed_grid(), scratch("buildings.xml", content))


def _map(content: bytes) -> object:
    source = scratch("some.map", content)
    return build_network(source, source.with_name("made.net.xml"), timeout_s=NETCONVERT_S)


def _cached(content: bytes) -> RoadNetwork:
    source, entry = _source_and_entry()
    entry.write_bytes(content)
    return load_network(source)


@cache
def _source_and_entry() -> tuple[Path, Path]:
    # The comment makes the cache entry unique to this process.
    process = scratch("cached.net.xml", b"").parent.name
    source = scratch("cached.net.xml", seed("crossing.net.xml") + f"<!--{process}-->".encode())
    return source, _entry(source_hash(source))


def _zones(content: bytes) -> ZonePartition:
    return read_zones(scratch("zones.json", content))


def _zone_files() -> tuple[bytes, ...]:
    path = scratch("seed.json", b"")
    found = []
    for layout in ("grid", "bisection"):
        write_zones(path, cut_map(grid(), layout, 4))
        found.append(path.read_bytes())
    return tuple(found)


def _entries() -> tuple[bytes, ...]:
    source, entry = _source_and_entry()
    entry.unlink(missing_ok=True)
    load_network(source)
    return (entry.read_bytes(),)


NETWORKS = Target(_network, _networks)
PROGRAMS = Target(_programs, lambda: (seed("programs.add.xml"),))
BUILDINGS = Target(_buildings, lambda: (seed("buildings.osm"), seed("buildings.poly.xml")))
MAPS = Target(_map, lambda: (seed("small.osm"), seed("small.xodr")), slow=True)
CACHED = Target(_cached, _entries)
ZONES = Target(_zones, _zone_files)
