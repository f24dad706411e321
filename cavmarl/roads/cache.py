"""Networks kept between runs: one file a source, named after the hash of what went into it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from cavmarl.core.atomic_file import write_whole
from cavmarl.core.cache_folder import cache_dir, tell_unwritable
from cavmarl.core.mapped_file import mapped
from cavmarl.roads.kernels.backdrop_pieces import WALL
from cavmarl.roads.network import (
    CONFLICT,
    DETECTOR,
    EDGE,
    JUNCTION,
    LANE,
    LINK,
    PHASE,
    POINT,
    PROGRAM,
    SIGNAL,
    SWEEP,
    SWITCH,
    GeoReference,
    RoadNetwork,
)
from cavmarl.roads.sumo_net.reader import map_name, read_network, source_hash

# Raise this when the reader gives other rows for the same file; record types count by themselves.
FORMAT = 49

_DIGEST_BYTES = 32  # SHA-256 of the rest begins an entry: of a broken one nothing is read
_ALIGNED = 64  # arrays begin at multiples of so many bytes

_DTYPES = {
    "points": POINT,
    "lanes": LANE,
    "edges": EDGE,
    "links": LINK,
    "conflicts": CONFLICT,
    "sweeps": SWEEP,
    "junctions": JUNCTION,
    "into": np.dtype(np.int32),
    "signals": SIGNAL,
    "programs": PROGRAM,
    "phases": PHASE,
    "phase_states": np.dtype(np.uint8),
    "switches": SWITCH,
    "detectors": DETECTOR,
    "phase_detectors": np.dtype(np.int32),
    "walls": WALL,
    "roofs": np.dtype(np.float64),
    "roof_height": np.dtype(np.float64),
}
_IDS = ("lane_ids", "edge_ids", "junction_ids", "signal_ids", "program_ids", "junction_kinds")


def load_network(path: str | Path) -> RoadNetwork:
    """`read_network` with a cache beside the compiled kernels; a broken cache entry is built again.

    Raises MapError: see `read_network`.
    """
    return _kept(Path(path), "", read_network)


def derived_network(
    path: str | Path, what: str, derive: Callable[[RoadNetwork], RoadNetwork]
) -> RoadNetwork:
    """What is made of the network of a map file, in the same cache; `what` names it.

    Raises MapError: see `read_network`.
    """
    return _kept(Path(path), f"-{what}", lambda source: derive(load_network(source)))


def _kept(path: Path, what: str, make: Callable[[Path], RoadNetwork]) -> RoadNetwork:
    digest = source_hash(path)
    entry = _entry(f"{digest}{what}")
    network = _restore(entry, map_name(path), digest)
    if network is None:
        network = make(path)
        try:
            _store(entry, network)
        except OSError as error:
            tell_unwritable(error)
    return network


def network_layout() -> str:
    """Short hash of the records of a packed network: another layout cannot be read."""
    columns = [dtype.descr for dtype in _DTYPES.values()]
    return hashlib.sha256(repr((FORMAT, columns)).encode()).hexdigest()[:12]


def pack_network(network: RoadNetwork) -> bytes:
    """All of a network but its name and the hash of its source, for `unpack_network`."""
    pieces: list[bytes] = []
    sizes: dict[str, int] = {}
    for name in _DTYPES:
        content = getattr(network, name).tobytes()
        sizes[name] = len(content)
        pieces += [content, bytes(-len(content) % _ALIGNED)]
    told: dict[str, Any] = {name: getattr(network, name) for name in _IDS}
    told["left_hand"] = network.left_hand
    told["geo"] = None if network.geo is None else asdict(network.geo)
    head = json.dumps({"sizes": sizes, "told": told}).encode()
    start = len(head).to_bytes(8, "little") + head
    start += bytes(-(_DIGEST_BYTES + len(start)) % _ALIGNED)
    content = b"".join([start, *pieces])
    return hashlib.sha256(content).digest() + content


def unpack_network(content: bytes | memoryview, name: str, digest: str) -> RoadNetwork | None:
    """The network that `pack_network` of the same layout has packed, or None if it is damaged.

    Its arrays are views of what was packed.

    Args:
        content: what was packed.
        name: of the network.
        digest: SHA-256 of its source, hex.
    """
    view = memoryview(content)
    if hashlib.sha256(view[_DIGEST_BYTES:]).digest() != view[:_DIGEST_BYTES]:
        return None
    begin = _DIGEST_BYTES + 8
    at = begin + int.from_bytes(view[_DIGEST_BYTES:begin], "little")
    head = json.loads(bytes(view[begin:at]))
    values: dict[str, Any] = {}
    for key, kind in _DTYPES.items():
        at += -at % _ALIGNED
        size = head["sizes"][key]
        # No array copy: it would leave the padding of the records undefined, and hashes read it.
        values[key] = np.frombuffer(view[at : at + size], dtype=kind)
        at += size
    told = head["told"]
    values |= {key: tuple(told[key]) for key in _IDS}
    values["roofs"] = values["roofs"].reshape(-1, 4, 2)
    values["geo"] = None if told["geo"] is None else GeoReference(**told["geo"])
    return RoadNetwork(name=name, source_hash=digest, left_hand=told["left_hand"], **values)


def _entry(digest: str) -> Path:
    return cache_dir() / "maps" / f"{digest}-{network_layout()}.network"


def _restore(entry: Path, name: str, digest: str) -> RoadNetwork | None:
    """The network of a cache entry, or None if there is no whole one."""
    try:
        content = mapped(entry)
    except (OSError, ValueError):  # it is not there, or empty
        return None
    return unpack_network(memoryview(content), name, digest)


def _store(entry: Path, network: RoadNetwork) -> None:
    content = pack_network(network)
    entry.parent.mkdir(parents=True, exist_ok=True)
    write_whole(entry, content)  # other processes may read it at any time
