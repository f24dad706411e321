"""The format of a recording on disk: its files, its columns, and frames as tables and back.

    PATH/recording.json         version, manifest, zones; written first, closed last
    PATH/network.bin            the map, as packed by `roads.cache.pack_network`
    PATH/world-0/vehicles/      one row per vehicle and frame
    PATH/world-0/events/        one row per event
    PATH/world-0/frames/        one row per frame, with lists of signals, transfers and ghosts
    PATH/world-0/observations/  and other optional tables, see `extra_tables`

Each of these folders has one file per part: `000000.parquet` and so on. The file in `frames/` is
written last and commits the part; other files of a part without it are ignored.
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
TABLES = ("vehicles", "events", "frames")  # in every recording; the last one commits a part

ALIGNED = 64  # alignment of columns in memory, bytes
# Numbers that rarely repeat: their bytes are split into streams, which compress better.
_SPLIT = [name for name in SEEN.names or () if SEEN[name].kind == "f"]
_OPTIONS: dict[str, Any] = {
    "compression": "lz4",
    "use_dictionary": ["kind", "detail"],
    "use_byte_stream_split": _SPLIT,
    "write_statistics": False,
    "write_batch_size": 1 << 16,
    "write_page_checksum": True,  # detects damaged files when they are read
}


Columns = Sequence[Sequence[Any]]  # name, dtype and shape of each column, as in JSON


class RecordedFrame(NamedTuple):
    """A frame and the index of its episode."""

    episode: int  # from 0, since the start of the recording
    frame: WorldFrame


class RecordedEvent(NamedTuple):
    """An event between two frames, and the index of its episode."""

    episode: int
    event: FrameEvent


@dataclass(frozen=True)
class RecordingHead:
    """The contents of `recording.json`."""

    environment: str  # name and version
    sim_dt_s: float  # seconds per tick
    step_s: float  # seconds between frames, unless the frame has another time
    network: Mapping[str, str]  # name, source_sha256, layout, sha256 of the file
    bounds: Sequence[float]  # of all zones: min_x, min_y, max_x, max_y in m
    rects: Sequence[Sequence[float]]  # of each zone: min_x, min_y, max_x, max_y in m
    halo_m: float
    manifest: Mapping[str, Any]  # manifest of the run
    status: str = "open"  # "closed" after an orderly end
    # optional tables by name: name, dtype and shape of each column
    extras: Mapping[str, Columns] = field(default_factory=dict)
    features: Sequence[Sequence[str]] = ()  # sensor and name of each observed number, newest frame
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
        """Read `recording.json`; raises RecordingError: missing, damaged or of another version."""
        path = folder / HEAD_FILE
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            kind = "an empty folder" if folder.is_dir() else "no folder"
            raise RecordingError(
                f"{folder}: no {HEAD_FILE}; it is {kind} or no recording: give the path that "
                "was given to `record`"
            ) from None
        except (OSError, ValueError, RecursionError) as error:
            raise RecordingError(
                f"{path}: cannot be read ({error}); restore it, or record the run again"
            ) from error
        if not isinstance(document, dict) or "cavmarl_recording" not in document:
            raise RecordingError(f"{path}: not the head of a recording; record the run again")
        version = document.pop("cavmarl_recording")
        if version != FORMAT_VERSION:
            raise RecordingError(
                f"{path}: the recording has format {version!r}, but this version reads "
                f"{FORMAT_VERSION}; use the version of cavmarl that wrote it"
            )
        try:
            head = cls(**document)
            head.partition  # noqa: B018 - refuses zones that are none
            list(map(dtype_of, head.extras.values()))
            hash((head.network["sha256"], head.network["name"], head.network["source_sha256"]))
            if not (head.sim_dt_s > 0.0 and head.step_s > 0.0 and "world" in head.manifest):
                raise ValueError("a key is missing")
        except Exception as error:
            raise RecordingError(
                f"{path}: is damaged ({error}); restore it, or record the run again"
            ) from error
        return head


def columns_of(dtype: np.dtype[Any]) -> list[list[Any]]:
    """Convert a dtype to JSON."""
    found = []
    for name in dtype.names or ():
        base, shape = dtype[name].base, list(dtype[name].shape)
        found.append([name, base.str, shape])
    return found


def dtype_of(columns: Columns) -> np.dtype[Any]:
    """Convert JSON of `columns_of` to a dtype; raises ValueError or TypeError if invalid."""
    return np.dtype([(str(name), str(kind), tuple(shape)) for name, kind, shape in columns])


def arrow() -> Any:
    """Return pyarrow; raises MissingExtraError: it is not installed."""
    return require("pyarrow", "record")


def write_table(table: Any) -> bytes:
    """Serialize a table as a Parquet file."""
    pa, parquet = arrow(), require("pyarrow.parquet", "record")
    sink = pa.BufferOutputStream()
    split = [name for name in _SPLIT if name in table.column_names]
    coded = [name for name in ("kind", "detail") if name in table.column_names]
    options = {**_OPTIONS, "use_byte_stream_split": split or False, "use_dictionary": coded}
    parquet.write_table(table, sink, **options)
    return bytes(sink.getvalue())


def read_table(path: Path) -> Any:
    """Read the table in a part's file.

    Raises:
        RecordingError: the file is missing or damaged.
    """
    parquet = require("pyarrow.parquet", "record")
    try:
        return parquet.read_table(path, page_checksum_verification=True, partitioning=None)
    except FileNotFoundError:
        raise RecordingError(
            f"{path}: is missing, although its part was committed; restore it, or remove the files "
            "with that name and the later ones to read the earlier parts"
        ) from None
    except (OSError, ValueError, KeyError) as error:  # pyarrow's errors are derived from these
        raise damaged(path, str(error)) from error


def damaged(path: Path, why: str) -> RecordingError:
    """Return the error for a damaged file."""
    return RecordingError(
        f"{path}: is damaged ({why}); restore it, or remove the files with that name and the later "
        "ones to read the earlier parts"
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
    # A null-free schema writes no null bits, which would take a third of the time.
    fields = [pa.field(name, array.type, nullable=False) for name, array in arrays.items()]
    return pa.Table.from_arrays(list(arrays.values()), schema=pa.schema(fields))


def _columns_of(raw: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Split the bytes of SEEN (n,) into its fields."""
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
    """Return the frames of a part, from its tables `frames` and `vehicles`.

    Args:
        path: the file of its `frames`, for errors.
        world: index of the world.
        table: its `frames`.
        vehicles: its `vehicles`.

    Raises:
        RecordingError: a column is missing or of another type, or the tables do not belong
            together.
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
            raise ValueError("its vehicles have other ticks")
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
    """Return the events of a part; raises as `frames_of`."""
    try:
        columns = [table.column(name).to_pylist() for name in ("episode", *FrameEvent._fields)]
    except KeyError as error:
        raise damaged(path, str(error)) from error
    rows = zip(*columns, strict=True)
    return [RecordedEvent(episode, FrameEvent(*event)) for episode, *event in rows]
