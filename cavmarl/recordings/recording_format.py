"""How a recording lies on disk: its files, its columns, frames as tables and back.

    PATH/recording.json         what it is: version, manifest, zones; written first, closed last
    PATH/network.bin            the map, as `roads.cache.pack_network` packs it
    PATH/world-0/vehicles/      a row a vehicle and frame
    PATH/world-0/events/        a row an event
    PATH/world-0/frames/        a row a frame; its lists have signals, transfers and ghosts
    PATH/world-0/observations/  and other tables on request, see `extra_tables`

Each of these folders has a file for each part, `000000.parquet` and so on. That in `frames/` is
written last and commits the part: what lies beside it without one does not count.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import RecordingError, require
from cavmarl.engine.kernels.seen_rows import split_rows
from cavmarl.engine.world_frame import ENDED, SEEN, FrameEvent, WorldFrame
from cavmarl.handoff.zone_view import TransferInFlight
from cavmarl.zones.partition.zone_partition import ZonePartition

FORMAT_VERSION = 2
HEAD_FILE = "recording.json"
NETWORK_FILE = "network.bin"
TABLES = ("vehicles", "events", "frames")  # of every recording; the last one commits a part

ALIGNED = 64  # bytes, of columns in memory
# Numbers that hardly repeat: their bytes are split into streams, which compress.
_SPLIT = [name for name in SEEN.names or () if SEEN[name].kind == "f"]
_OPTIONS: dict[str, Any] = {
    "compression": "lz4",
    "use_dictionary": ["kind", "detail"],
    "use_byte_stream_split": _SPLIT,
    "write_statistics": False,
    "write_batch_size": 1 << 16,
    "write_page_checksum": True,  # so that a damaged file is found when it is read
}


Columns = Sequence[Sequence[Any]]  # name, dtype and shape of each column, as JSON has them


class RecordedFrame(NamedTuple):
    """A frame, and which episode of its world it belongs to."""

    episode: int  # from 0, since the recording began
    frame: WorldFrame


class RecordedEvent(NamedTuple):
    """An event between two frames, and its episode."""

    episode: int
    event: FrameEvent


@dataclass(frozen=True)
class RecordingHead:
    """What stands in `recording.json`."""

    environment: str  # its name and version
    sim_dt_s: float  # seconds a tick
    step_s: float  # seconds from frame to frame, unless it says another
    network: Mapping[str, str]  # name, source_sha256, layout, sha256 of the file
    bounds: Sequence[float]  # of the zones, min_x, min_y, max_x, max_y in m
    rects: Sequence[Sequence[float]]  # of each zone, likewise
    halo_m: float
    manifest: Mapping[str, Any]  # of the run
    status: str = "open"  # "closed" when it was ended in order
    # of tables on request, by name: name, dtype and shape of each column
    extras: Mapping[str, Columns] = field(default_factory=dict)
    features: Sequence[Sequence[str]] = ()  # sensor and name of each number observed, newest frame
    terms: Sequence[str] = ()  # names of the reward terms
    version: int = FORMAT_VERSION

    @property
    def partition(self) -> ZonePartition:
        low_x, low_y, high_x, high_y = self.bounds
        return ZonePartition((low_x, low_y, high_x, high_y), np.array(self.rects))

    def closed(self) -> RecordingHead:
        return replace(self, status="closed")

    def to_bytes(self) -> bytes:
        return (json.dumps({"cavmarl_recording": self.version, **asdict(self)}) + "\n").encode()

    @classmethod
    def read(cls, folder: Path) -> RecordingHead:
        """Raises RecordingError: there is none, or it is damaged or of another version."""
        path = folder / HEAD_FILE
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            what = "an empty folder" if folder.is_dir() else "no folder"
            raise RecordingError(
                f"{folder}: no {HEAD_FILE}; it is {what} or no recording: give the path that "
                "`record` was given"
            ) from None
        except (OSError, ValueError, RecursionError) as error:
            raise RecordingError(
                f"{path}: cannot be read ({error}); restore it, or record the run again"
            ) from error
        if not isinstance(document, dict) or "cavmarl_recording" not in document:
            raise RecordingError(f"{path}: does not belong to a recording; record the run again")
        version = document.pop("cavmarl_recording")
        if version != FORMAT_VERSION:
            raise RecordingError(
                f"{path}: a recording of format {version!r}, but this version reads "
                f"{FORMAT_VERSION}; use the version of cavmarl that wrote it"
            )
        try:
            head = cls(**document)
            head.partition  # noqa: B018 - refuses zones that are none
            list(map(dtype_of, head.extras.values()))
            hash((head.network["sha256"], head.network["name"], head.network["source_sha256"]))
            if not (head.sim_dt_s > 0.0 and head.step_s > 0.0 and "world" in head.manifest):
                raise ValueError("a key has no value")
        except Exception as error:
            raise RecordingError(
                f"{path}: is damaged ({error}); restore it, or record the run again"
            ) from error
        return head


def columns_of(dtype: np.dtype[Any]) -> list[list[Any]]:
    """A dtype as JSON."""
    found = []
    for name in dtype.names or ():
        base, shape = dtype[name].base, list(dtype[name].shape)
        found.append([name, base.str, shape])
    return found


def dtype_of(columns: Columns) -> np.dtype[Any]:
    """The dtype that `columns_of` told; raises ValueError or TypeError: it is none."""
    return np.dtype([(str(name), str(kind), tuple(shape)) for name, kind, shape in columns])


def arrow() -> Any:
    """pyarrow; raises MissingExtraError: it is not installed."""
    return require("pyarrow", "record")


def write_table(table: Any) -> bytes:
    """A table as a Parquet file."""
    pa, parquet = arrow(), require("pyarrow.parquet", "record")
    sink = pa.BufferOutputStream()
    split = [name for name in _SPLIT if name in table.column_names]
    coded = [name for name in ("kind", "detail") if name in table.column_names]
    options = {**_OPTIONS, "use_byte_stream_split": split or False, "use_dictionary": coded}
    parquet.write_table(table, sink, **options)
    return bytes(sink.getvalue())


def read_table(path: Path) -> Any:
    """The table of a part's file.

    Raises:
        RecordingError: it is missing or damaged.
    """
    parquet = require("pyarrow.parquet", "record")
    try:
        return parquet.read_table(path, page_checksum_verification=True, partitioning=None)
    except FileNotFoundError:
        raise RecordingError(
            f"{path}: is missing, though its part was committed; restore it, or take the files "
            "of that name and the later ones away to read what is before"
        ) from None
    except (OSError, ValueError, KeyError) as error:  # pyarrow's own are ValueErrors and OSErrors
        raise damaged(path, str(error)) from error


def damaged(path: Path, why: str) -> RecordingError:
    """The error of a file that is not what was written."""
    return RecordingError(
        f"{path}: is damaged ({why}); restore it, or take the files of that name and the later "
        "ones away to read what is before"
    )


def vehicle_table(frames: Sequence[RecordedFrame]) -> Any:
    pa = arrow()
    counts = [len(one.frame.vehicles) for one in frames]
    columns = {
        "episode": np.repeat(np.array([one.episode for one in frames], np.int32), counts),
        "tick": np.repeat(np.array([one.frame.tick for one in frames], np.int64), counts),
    }
    columns |= _columns_of(np.concatenate([one.frame.vehicles.view(np.uint8) for one in frames]))
    arrays = {name: pa.array(column) for name, column in columns.items()}
    # Without nulls none of their bits is written: that takes a third of the time.
    fields = [pa.field(name, array.type, nullable=False) for name, array in arrays.items()]
    return pa.Table.from_arrays(list(arrays.values()), schema=pa.schema(fields))


def _columns_of(raw: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """The fields of the bytes of SEEN (n,) as arrays."""
    sizes = np.array([SEEN[name].itemsize for name in SEEN.names or ()])
    count = len(raw) // SEEN.itemsize
    room = -(-sizes * count // ALIGNED) * ALIGNED
    ends = np.cumsum(room)
    out = np.empty(int(ends[-1]), np.uint8)
    split_rows(raw.reshape(count, SEEN.itemsize), np.cumsum([0, *sizes]), ends - room, out)
    return {
        name: out[end - own : end - own + size * count].view(SEEN[name])
        for name, size, own, end in zip(SEEN.names or (), sizes, room, ends, strict=True)
    }


def frame_table(frames: Sequence[RecordedFrame]) -> Any:
    pa = arrow()
    kinds = (pa.int64(), pa.int32(), pa.int32(), pa.string())
    transfer = pa.struct(list(zip(TransferInFlight._fields, kinds, strict=True)))
    ended = pa.struct([("agent", pa.int32()), ("events", pa.int32())])
    schema = pa.schema(
        [
            ("episode", pa.int32()),
            ("tick", pa.int64()),
            ("time_s", pa.float64()),
            ("num_vehicles", pa.int32()),
            ("signals", pa.list_(pa.int32())),
            ("transfers", pa.list_(transfer)),
            ("ghosts", pa.list_(pa.list_(pa.int64()))),
            ("ended", pa.list_(ended)),
            ("asked", pa.list_(pa.struct([("kind", pa.string()), ("detail", pa.string())]))),
        ]
    )
    rows = [
        {
            "episode": episode,
            "tick": frame.tick,
            "time_s": frame.time_s,
            "num_vehicles": len(frame.vehicles),
            "signals": frame.signals.tolist(),
            "transfers": [transfer._asdict() for transfer in frame.transfers],
            "ghosts": [ghosts.tolist() for ghosts in frame.ghosts],
            "ended": [{"agent": agent, "events": events} for agent, events in frame.ended.tolist()],
            "asked": [{"kind": kind, "detail": detail} for kind, detail in frame.asked],
        }
        for episode, frame in frames
    ]
    return pa.Table.from_pylist(rows, schema=schema)


def event_table(events: Iterable[RecordedEvent]) -> Any:
    pa = arrow()
    kinds = [pa.int32(), pa.int64(), pa.string(), pa.int64(), pa.int32(), pa.string()]
    schema = pa.schema(list(zip(("episode", *FrameEvent._fields), kinds, strict=True)))
    rows = [(episode, *event) for episode, event in events]
    columns = list(zip(*rows, strict=True)) or [()] * len(kinds)
    arrays = [pa.array(column, kind) for column, kind in zip(columns, kinds, strict=True)]
    return pa.Table.from_arrays(arrays, schema=schema)


def frames_of(path: Path, world: int, table: Any, vehicles: Any) -> list[RecordedFrame]:
    """The frames of a part, of its `frames` and `vehicles`.

    Args:
        path: of its `frames`, for errors.
        world: its number.
        table: its `frames`.
        vehicles: its `vehicles`.

    Raises:
        RecordingError: a column is missing or of another kind, or the two do not belong together.
    """
    try:
        rows = np.empty(vehicles.num_rows, dtype=SEEN)
        for name in SEEN.names or ():
            rows[name] = vehicles.column(name).to_numpy()
        ticks = vehicles.column("tick").to_numpy()
        found = table.to_pylist()
        counts = np.array([row["num_vehicles"] for row in found], dtype=np.int64)
        named = np.repeat(np.array([row["tick"] for row in found], dtype=np.int64), counts)
        if not np.array_equal(ticks, named):
            raise ValueError("its vehicles are of other ticks")
        ends = np.cumsum(counts)
        return [
            RecordedFrame(row["episode"], _frame(world, row, rows[end - count : end].copy()))
            for row, count, end in zip(found, counts.tolist(), ends.tolist(), strict=True)
        ]
    except (KeyError, TypeError, ValueError) as error:
        raise damaged(path, str(error)) from error


def _frame(world: int, row: Mapping[str, Any], vehicles: NDArray[np.void]) -> WorldFrame:
    ended = [(end["agent"], end["events"]) for end in row["ended"]]
    return WorldFrame(
        world,
        row["tick"],
        row["time_s"],
        vehicles,
        np.array(row["signals"], dtype=np.int32),
        tuple(TransferInFlight(**transfer) for transfer in row["transfers"]),
        tuple(np.array(ids, dtype=np.int64) for ids in row["ghosts"]),
        np.array(ended, dtype=ENDED),
        tuple((one["kind"], one["detail"]) for one in row["asked"]),
    )


def events_of(path: Path, table: Any) -> list[RecordedEvent]:
    """The events of a part; errors as of `frames_of`."""
    try:
        columns = [table.column(name).to_pylist() for name in ("episode", *FrameEvent._fields)]
    except KeyError as error:
        raise damaged(path, str(error)) from error
    rows = zip(*columns, strict=True)
    return [RecordedEvent(episode, FrameEvent(*event)) for episode, *event in rows]
