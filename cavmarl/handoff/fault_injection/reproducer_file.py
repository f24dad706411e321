"""`Reproducer`: a tick that no host survived, as a file from which it can be run again.

A file is one JSON object on one line: `schema`, what is in `Reproducer`, and `checksum`: BLAKE2b of
16 bytes, in hex, over the line as it would be without that key. An array is its shape, the digest
of its type, and its bytes, deflated and in base64.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.format import descr_to_dtype
from numpy.typing import NDArray

from cavmarl.core.errors import JournalError
from cavmarl.handoff.fault_injection.committed_store import COUNTS, CommittedImage, Notes
from cavmarl.ownership.log_records import LogChain
from cavmarl.ownership.messages import Birth, Fence, Host, Record, Removed, Reset
from cavmarl.shards.shard import Commands

SCHEMA = "cavmarl.reproducer/1"
MAX_BYTES = 1 << 31  # of one array: a damaged length shall not fill the memory

Array = NDArray[Any]


@dataclass(frozen=True)
class Reproducer:
    """A tick of one world, and all that it is a function of."""

    made_with: Mapping[str, str | None]  # versions of what has run it
    config: Mapping[str, Any]  # the environment, as plain values
    sources: Mapping[str, str | None]  # hashes of its roads, demand and zones
    seed: int  # root of all random numbers
    first_world: int  # number of the world among all worlds of the seed
    episode: int  # number of the world's episode since the seed, from 1 on
    tick: int  # of the run, that could not be reached
    zone: int | None  # whose hosts died; None: the coordinators
    cause: str  # what the error said
    is_first: bool  # whether the tick begins a step
    is_last: bool  # whether it ends one
    commands: Commands  # of the agents, W = 1
    # of the coordinator, as far as the episode needs them, up to the committed tick, and the BEGIN
    # of the one that could not be reached if there is one
    records: tuple[Record, ...]
    image: CommittedImage  # of the committed tick

    def write(self, path: Path) -> None:
        """Write the file, which must not exist. Raises OSError: it cannot be written."""
        plain = {name: dict(getattr(self, name)) for name in ("made_with", "config", "sources")}
        chain = LogChain()
        names = ("seed", "first_world", "episode", "tick", "zone", "cause", "is_first", "is_last")
        content = {
            "schema": SCHEMA,
            **plain,
            **{name: getattr(self, name) for name in names},
            "commands": [_packed(array) for array in vars(self.commands).values()],
            "records": [chain.to_dict(record) for record in self.records],
            "image": _image_to_plain(self.image),
        }
        body = _json(content)
        with path.open("x", encoding="ascii") as file:
            file.write(f'{body[:-1]},"checksum":"{_checksum(body)}"}}\n')


def read_reproducer(path: Path) -> Reproducer:
    try:
        content = json.loads(path.read_text(encoding="ascii"))
    except OSError as error:
        raise JournalError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise JournalError(f"{path}: damaged, or no reproducer: {error}") from error
    found = content.get("schema") if isinstance(content, dict) else None
    if found != SCHEMA:
        raise JournalError(f"{path}: has schema {found!r}; this version reads {SCHEMA!r}")
    checksum = content.pop("checksum", None)
    if checksum != _checksum(_json(content)):
        raise JournalError(f"{path}: damaged: it does not match its checksum")
    del content["schema"]
    try:
        content["commands"] = Commands(*(_unpacked(entry) for entry in content["commands"]))
        chain = LogChain()
        content["records"] = tuple(chain.from_dict(line) for line in content["records"])
        content["image"] = _image_from_plain(content["image"])
        return Reproducer(**content)
    except (JournalError, KeyError, TypeError, ValueError, zlib.error) as error:
        raise JournalError(f"{path}: written by something else? {error!r}") from error


def needed_records(records: Iterable[Record]) -> tuple[Record, ...]:
    """Of a journal what the present episode needs to be taken up where the last COMMIT left it.

    New hosts of a tick that has begun are left out: a replay begins it with the first.
    """
    log = list(records)
    last = max(k for k, record in enumerate(log) if isinstance(record, Reset))
    begun = max(k for k, record in enumerate(log) if not isinstance(record, Host | Fence))
    before = [record for record in log[:last] if isinstance(record, Host | Fence)]
    return (log[0], *before, *log[last : begun + 1]) if last else tuple(log[: begun + 1])


def _packed(array: Array) -> dict[str, Any]:
    data = base64.b64encode(zlib.compress(np.ascontiguousarray(array).tobytes())).decode()
    dtype = array.dtype.str if array.dtype.names is None else array.dtype.descr
    return {"dtype": dtype, "shape": list(array.shape), "data": data}


def _unpacked(entry: Any) -> Array:
    dtype, shape = _dtype(entry["dtype"]), tuple(entry["shape"])
    data = zlib.decompressobj().decompress(base64.b64decode(entry["data"]), MAX_BYTES)
    return np.frombuffer(data, dtype=dtype).reshape(shape)


def _dtype(plain: Any) -> np.dtype[Any]:
    """The type of a `dtype.descr` that has been through JSON, gaps between its fields included."""
    found: np.dtype[Any] = descr_to_dtype(_descr(plain))
    return found


def _descr(plain: Any) -> Any:
    if isinstance(plain, str):
        return plain
    return [(name, _descr(inner), *map(tuple, shape)) for name, inner, *shape in plain]


def _image_to_plain(image: CommittedImage) -> dict[str, Any]:
    return {
        "counts": [
            dict(zip(COUNTS, (int(array[0]) for array in counts), strict=True))
            for counts in image.counts
        ],
        "rows": [_packed(rows[0]) for rows in image.rows],
        "shared": [_packed(array) for array in image.shared],
        "births": [[vehicle, zone, state.hex()] for vehicle, zone, state in image.notes[0][0]],
        "gone": [list(entry) for entry in image.notes[0][1]],
    }


def _image_from_plain(plain: Any) -> CommittedImage:
    births = tuple(Birth(int(v), int(zone), bytes.fromhex(s)) for v, zone, s in plain["births"])
    gone = tuple(Removed(int(vehicle), int(reason)) for vehicle, reason in plain["gone"])
    notes: Notes = births, gone
    return CommittedImage(
        counts=[
            [np.array([counts[name]], dtype=np.int64) for name in COUNTS]
            for counts in plain["counts"]
        ],
        rows=[[_unpacked(rows)] for rows in plain["rows"]],
        shared=[_unpacked(array) for array in plain["shared"]],
        notes=(notes,),
    )


def _checksum(body: str) -> str:
    return blake2b(body.encode(), digest_size=16).hexdigest()


_json = json.JSONEncoder(separators=(",", ":")).encode
