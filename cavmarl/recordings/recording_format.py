"""The format of a recording on disk: files, columns, and conversion between frames and tables.

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
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain, pairwise, starmap
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import RecordingError, require
from cavmarl.engine.kernels.seen_rows import split_rows
from cavmarl.engine.world_frame import ENDED, SEEN, FrameEvent, WorldFrame
from cavmarl.handoff.zone_view import TransferInFlight
from cavmarl.recordings.frame_check import MOST_SECONDS, wrong_frames
from cavmarl.recordings.part_files import damaged, read_file
from cavmarl.zones.partition.zone_partition import ZonePartition

FORMAT_VERSION = 2
HEAD_FILE = "recording.json"
NETWORK_FILE = "network.bin"
TABLES = ("vehicles", "events", "frames")  # in every recording; the last table commits a part

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


MOST_LETTERS = 1000  # limit of letters of a text in the head
MOST_SHOWN = 100
MOST_ROW_BYTES = 1 << 28  # limit of the size of a row in a table of samples
SHORTEST_S, LONGEST_S = 1e-4, 1e3  # limits of the length of a tick or step
_EXTRA = re.compile(r"observations|commands|v2x|handovers|samples-[^/\\\x00]{1,200}")
_WHOSE = ("tick", "agent", "vehicle")
_NEEDED = {
    "observations": (*_WHOSE, "reward", "terms", "values"),
    "samples": (*_WHOSE, "data", "stamp_s", "lost"),
}
_ARRAYS = ("terms", "values", "data")

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
    step_s: float  # usual seconds between frames; `time_s` of a frame is exact
    network: Mapping[str, str]  # name, source_sha256, layout, sha256 of the file
    bounds: Sequence[float]  # min_x, min_y, max_x, max_y of all zones in m
    rects: Sequence[Sequence[float]]  # min_x, min_y, max_x, max_y of each zone in m
    halo_m: float
    manifest: Mapping[str, Any]  # manifest of the run
    status: str = "open"  # "closed" after an orderly end
    # optional tables by name: name, dtype and shape of each column
    extras: Mapping[str, Columns] = field(default_factory=dict)
    features: Sequence[Sequence[str]] = ()  # sensor and name of each number of the newest frame
    terms: Sequence[str] = ()  # names of the reward terms
    version: int = FORMAT_VERSION

    @property
    def partition(self) -> ZonePartition:
        low_x, low_y, high_x, high_y = self.bounds
        return ZonePartition((low_x, low_y, high_x, high_y), np.array(self.rects))

    def wrong(self) -> str:
        """Return what is wrong with a head from a file; empty if nothing. Wrong types may raise."""
        self.partition  # noqa: B018 - raises for invalid zones
        texts = [self.network[key] for key in ("name", "source_sha256", "layout", "sha256")]
        texts += [self.environment, self.status, *self.terms, *chain(*self.features)]
        if not all(isinstance(text, str) and len(text) <= MOST_LETTERS for text in texts):
            return f"a value is not a text, or longer than {MOST_LETTERS} letters"
        if not all(text.isprintable() for text in texts):
            return "a text has letters that cannot be printed"
        if not 0.0 <= float(self.halo_m) <= MOST_SECONDS:
            return f"halo_m is {self.halo_m}"
        for name, seconds in (("sim_dt_s", self.sim_dt_s), ("step_s", self.step_s)):
            if not SHORTEST_S <= float(seconds) <= LONGEST_S:
                return f"{name} is {seconds}, not from {SHORTEST_S:g} to {LONGEST_S:g}"
        if not np.isfinite([*self.bounds, *np.ravel(self.rects)]).all():
            return "a zone has no finite bounds"
        if "world" not in self.manifest:
            return "the manifest has no world"
        return next(filter(None, starmap(self._wrong_extra, self.extras.items())), "")

    def _wrong_extra(self, name: str, columns: Columns) -> str:
        dtype = dtype_of(columns)
        if not _EXTRA.fullmatch(name):
            return f"no table is called {name[:MOST_SHOWN]!r}"
        if any(dtype[column].base.kind not in "biufO" for column in dtype.names or ()):
            return f"table {name} has a column that is neither numbers nor texts"
        needed = [*_NEEDED.get(name.partition("-")[0], ("tick",))]
        if missing := [column for column in needed if column not in (dtype.names or ())]:
            return f"table {name} has no column {missing[0]}"
        if any(dtype[column].shape for column in needed if column not in _ARRAYS):
            return f"table {name} has a list where it should have a number"
        if dtype.itemsize > MOST_ROW_BYTES:
            return f"table {name} has rows of {dtype.itemsize} bytes"
        if name == "observations":
            terms, values = dtype["terms"].shape, dtype["values"].shape
            if terms != (len(self.terms),) or len(values) != 1 or values[0] < len(self.features):
                return "the terms or features do not match the observations"
            if any(len(pair) != 2 for pair in self.features):
                return "a feature has no sensor or no name"
        return ""

    def closed(self) -> RecordingHead:
        return replace(self, status="closed")

    def to_bytes(self) -> bytes:
        return (json.dumps({"cavmarl_recording": self.version, **asdict(self)}) + "\n").encode()

    @classmethod
    def read(cls, folder: Path) -> RecordingHead:
        """Read `recording.json`; raises RecordingError: missing, damaged or of another version."""
        path = folder / HEAD_FILE
        try:
            document = json.loads(read_file(path).decode())
        except FileNotFoundError:
            kind = "the folder is no recording" if folder.is_dir() else "there is no such folder"
            raise RecordingError(
                f"{folder}: no {HEAD_FILE}; {kind}: give the path that was given to `record`"
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
            if wrong := head.wrong():
                raise ValueError(wrong)
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


def vehicle_table(frames: Sequence[RecordedFrame]) -> Any:
    pa = arrow()
    counts = [len(one.frame.vehicles) for one in frames]
    columns = {
        "episode": np.repeat(np.array([one.episode for one in frames], np.int32), counts),
        "tick": np.repeat(np.array([one.frame.tick for one in frames], np.int64), counts),
    }
    rows = [np.empty(0, np.uint8), *(one.frame.vehicles.view(np.uint8) for one in frames)]
    columns |= _columns_of(np.concatenate(rows))
    arrays = [pa.array(column) for column in columns.values()]
    return pa.Table.from_arrays(arrays, schema=vehicle_schema())


def vehicle_schema() -> Any:
    pa = arrow()
    kinds = {"episode": np.dtype(np.int32), "tick": np.dtype(np.int64)}
    kinds |= {name: SEEN[name] for name in SEEN.names or ()}
    # A null-free schema writes no null bits, which would take a third of the time.
    return pa.schema(
        [pa.field(name, pa.from_numpy_dtype(kind), nullable=False) for name, kind in kinds.items()]
    )


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


def frame_schema() -> Any:
    pa = arrow()
    kinds = (pa.int64(), pa.int32(), pa.int32(), pa.string())
    transfer = pa.struct(list(zip(TransferInFlight._fields, kinds, strict=True)))
    ended = pa.struct([("agent", pa.int32()), ("events", pa.int32())])
    return pa.schema(
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


def frame_table(frames: Sequence[RecordedFrame]) -> Any:
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
    return arrow().Table.from_pylist(rows, schema=frame_schema())


def event_schema() -> Any:
    pa = arrow()
    kinds = [pa.int32(), pa.int64(), pa.string(), pa.int64(), pa.int32(), pa.string()]
    return pa.schema(list(zip(("episode", *FrameEvent._fields), kinds, strict=True)))


def event_table(events: Iterable[RecordedEvent]) -> Any:
    pa, schema = arrow(), event_schema()
    rows = [(episode, *event) for episode, event in events]
    columns = list(zip(*rows, strict=True)) or [()] * len(schema)
    arrays = [pa.array(column, kind) for column, kind in zip(columns, schema.types, strict=True)]
    return pa.Table.from_arrays(arrays, schema=schema)


def frames_of(
    path: Path, world: int, table: Any, vehicles: Any, num_zones: int
) -> list[RecordedFrame]:
    """Return the frames of a part, from its tables `frames` and `vehicles`.

    Args:
        path: the file of the table `frames`, for error messages.
        world: index of the world.
        table: the table `frames` of the part.
        vehicles: the table `vehicles` of the part.
        num_zones: number of zones of the recording.

    Raises:
        RecordingError: the tables do not belong together, or a row is invalid.
    """
    counts = table.column("num_vehicles").to_numpy().astype(np.int64)
    if (counts < 0).any() or counts.sum() != vehicles.num_rows:
        raise damaged(path, f"num_vehicles does not add up to {vehicles.num_rows} vehicles")
    moments = {name: table.column(name).to_numpy() for name in ("episode", "tick", "time_s")}
    for name in ("episode", "tick"):
        named = np.repeat(moments[name], counts)
        if not np.array_equal(vehicles.column(name).to_numpy(), named):
            raise damaged(path, f"its vehicles have other {name}s")
    rows = np.empty(vehicles.num_rows, dtype=SEEN)
    for name in SEEN.names or ():
        rows[name] = vehicles.column(name).to_numpy()
    lists = {
        "signals": _lists_of(table.column("signals"), np.int32),
        "ghosts": _lists_of(table.column("ghosts"), np.int64),
    }
    records = {name: table.column(name).to_pylist() for name in ("transfers", "ended", "asked")}
    frames = []
    ends = np.cumsum(counts).tolist()
    for k, (count, end) in enumerate(zip(counts.tolist(), ends, strict=True)):
        ended = [(one["agent"], one["events"]) for one in records["ended"][k]]
        frame = WorldFrame(
            world,
            int(moments["tick"][k]),
            float(moments["time_s"][k]),
            rows[end - count : end].copy(),
            lists["signals"][k],
            tuple(TransferInFlight(**transfer) for transfer in records["transfers"][k]),
            tuple(lists["ghosts"][k]),
            np.array(ended, dtype=ENDED),
            tuple((one["kind"], one["detail"]) for one in records["asked"][k]),
        )
        frames.append(RecordedFrame(int(moments["episode"][k]), frame))
    if wrong := wrong_frames(frames, rows, num_zones):
        raise damaged(path, wrong)
    return frames


def _lists_of(column: Any, kind: type[np.generic]) -> list[Any]:
    """Return the lists of a column, or its lists of lists; the innermost lists become arrays."""
    array = arrow().concat_arrays(column.chunks or [arrow().array([], column.type)])
    offsets = array.offsets.to_numpy().tolist()
    if arrow().types.is_list(array.values.type):
        values: Any = _lists_of(arrow().chunked_array([array.values]), kind)
    else:
        values = array.values.to_numpy().astype(kind)
    return [values[start:end] for start, end in pairwise(offsets)]


def events_of(table: Any) -> list[RecordedEvent]:
    """Return the events of a part."""
    columns = [table.column(name).to_pylist() for name in ("episode", *FrameEvent._fields)]
    rows = zip(*columns, strict=True)
    return [RecordedEvent(episode, FrameEvent(*event)) for episode, *event in rows]
