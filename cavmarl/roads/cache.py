"""Networks kept between runs: one file a source, named after the hash of what went into it."""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.cache_folder import cache_dir, tell_unwritable
from cavmarl.core.whole_file import write_whole
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
FORMAT = 34

_DIGEST_BYTES = 32  # SHA-256 of the rest begins an entry: NumPy would stumble over a broken one

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
    path = Path(path)
    digest = source_hash(path)
    entry = _entry(digest)
    network = _restore(entry, map_name(path), digest)
    if network is None:
        network = read_network(path)
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
    stored: dict[str, NDArray[np.uint8]] = {}
    for field in fields(network):
        value = getattr(network, field.name)
        if field.name in _DTYPES:
            stored[field.name] = np.frombuffer(value.tobytes(), dtype=np.uint8)
        elif field.name in _IDS:
            stored[field.name] = _text(value)
    stored["left_hand"] = _text(network.left_hand)
    stored["geo"] = _text(None if network.geo is None else asdict(network.geo))
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **stored)
    content = buffer.getvalue()
    return hashlib.sha256(content).digest() + content


def unpack_network(content: bytes, name: str, digest: str) -> RoadNetwork | None:
    """The network that `pack_network` of the same layout has packed, or None if it is damaged.

    Args:
        content: what was packed.
        name: of the network.
        digest: SHA-256 of its source, hex.
    """
    if hashlib.sha256(content[_DIGEST_BYTES:]).digest() != content[:_DIGEST_BYTES]:
        return None
    with np.load(io.BytesIO(content[_DIGEST_BYTES:]), allow_pickle=False) as stored:
        values: dict[str, Any] = {key: _thaw(stored[key], kind) for key, kind in _DTYPES.items()}
        values |= {key: tuple(json.loads(stored[key].tobytes())) for key in _IDS}
        values["roofs"] = values["roofs"].reshape(-1, 4, 2)
        geo = json.loads(stored["geo"].tobytes())
        values["geo"] = None if geo is None else GeoReference(**geo)
        values["left_hand"] = bool(json.loads(stored["left_hand"].tobytes()))
    return RoadNetwork(name=name, source_hash=digest, **values)


def _entry(digest: str) -> Path:
    return cache_dir() / "maps" / f"{digest}-{network_layout()}.network"


def _restore(entry: Path, name: str, digest: str) -> RoadNetwork | None:
    """The network of a cache entry, or None if there is no whole one."""
    try:
        content = entry.read_bytes()
    except OSError:
        return None
    return unpack_network(content, name, digest)


def _store(entry: Path, network: RoadNetwork) -> None:
    content = pack_network(network)
    entry.parent.mkdir(parents=True, exist_ok=True)
    write_whole(entry, content)  # other processes may read it at any time


def _text(value: object) -> NDArray[np.uint8]:
    return np.frombuffer(json.dumps(value).encode(), dtype=np.uint8)


def _thaw(raw: NDArray[np.uint8], dtype: np.dtype[np.generic]) -> NDArray[np.void]:
    # No array copy: it would leave the padding of the records undefined, and hashes read it.
    return np.frombuffer(raw.tobytes(), dtype=dtype)
