"""A cache of networks on disk: one file per source, named after the hash of its content."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from cavmarl.core.atomic_file import write_whole
from cavmarl.core.cache_folder import cache_dir, report_unwritable
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

# Increase this if the reader returns different rows for a file. A changed record type needs no
# increase, because the record types are part of the hash.
FORMAT = 52

_DIGEST_BYTES = 32  # an entry begins with the SHA-256 of its rest; damaged entries are not read
_ALIGNED = 64  # arrays begin at multiples of this number of bytes

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
_TEXTS = (
    "lane_ids", "edge_ids", "junction_ids", "signal_ids", "program_ids", "junction_kinds", "notes",
)  # fmt: skip


def load_network(path: str | Path) -> RoadNetwork:
    """Read a network through the cache (folder `maps` in `cache_dir`); rebuild damaged entries.

    Raises MapError: see `read_network`.
    """
    return _cached(Path(path), "", read_network)


def derived_network(
    path: str | Path, what: str, derive: Callable[[RoadNetwork], RoadNetwork]
) -> RoadNetwork:
    """Return a network derived from a map file's network, cached under the name `what`.

    Raises MapError: see `read_network`.
    """
    return _cached(Path(path), f"-{what}", lambda source: derive(load_network(source)))


def _cached(path: Path, what: str, make: Callable[[Path], RoadNetwork]) -> RoadNetwork:
    digest = source_hash(path)
    entry = _entry(f"{digest}{what}")
    network = _restore(entry, map_name(path), digest)
    if network is None:
        network = make(path)
        try:
            _store(entry, network)
        except OSError as error:
            report_unwritable(error)
    return network


def network_layout() -> str:
    """Return a short hash of the layout of packed networks, for the names of cache entries."""
    columns = [dtype.descr for dtype in _DTYPES.values()]
    return hashlib.sha256(repr((FORMAT, columns)).encode()).hexdigest()[:12]


def pack_network(network: RoadNetwork) -> bytes:
    """Return a network as bytes for `unpack_network`, without the name and the source's hash."""
    pieces: list[bytes] = []
    sizes: dict[str, int] = {}
    for name in _DTYPES:
        content = getattr(network, name).tobytes()
        sizes[name] = len(content)
        pieces += [content, bytes(-len(content) % _ALIGNED)]
    facts: dict[str, Any] = {name: getattr(network, name) for name in _TEXTS}
    facts["left_hand"] = network.left_hand
    facts["geo"] = None if network.geo is None else asdict(network.geo)
    head = json.dumps({"sizes": sizes, "told": facts}).encode()
    start = len(head).to_bytes(8, "little") + head
    start += bytes(-(_DIGEST_BYTES + len(start)) % _ALIGNED)
    content = b"".join([start, *pieces])
    return hashlib.sha256(content).digest() + content


def unpack_network(content: bytes | memoryview, name: str, digest: str) -> RoadNetwork | None:
    """Return a network that `pack_network` packed in the same layout, or None if it is damaged.

    The network's arrays are views of the packed bytes.

    Args:
        content: the packed bytes.
        name: name of the network.
        digest: SHA-256 of the network's source, hex.
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
        # Do not copy arrays: copies would have undefined padding, which hashes include.
        values[key] = np.frombuffer(view[at : at + size], dtype=kind)
        at += size
    facts = head["told"]
    values |= {key: tuple(facts[key]) for key in _TEXTS}
    values["roofs"] = values["roofs"].reshape(-1, 4, 2)
    values["geo"] = None if facts["geo"] is None else GeoReference(**facts["geo"])
    return RoadNetwork(name=name, source_hash=digest, left_hand=facts["left_hand"], **values)


def _entry(digest: str) -> Path:
    return cache_dir() / "maps" / f"{digest}-{network_layout()}.network"


def _restore(entry: Path, name: str, digest: str) -> RoadNetwork | None:
    """Return the network of a cache entry, or None if it is missing or damaged."""
    try:
        content = mapped(entry)
    except (OSError, ValueError):  # the entry is missing or empty
        return None
    return unpack_network(memoryview(content), name, digest)


def _store(entry: Path, network: RoadNetwork) -> None:
    content = pack_network(network)
    entry.parent.mkdir(parents=True, exist_ok=True)
    write_whole(entry, content)  # other processes may read it at any time
