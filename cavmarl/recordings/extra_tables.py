"""Optional tables of a recording: each table has rows of one dtype.

The first field of a row is `tick`. A float32 column with one axis is stored as a list, any other
column with axes as bytes, and objects as text. `recording.json` has the dtypes, so rows are read
back unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.recordings.part_files import MOST_BYTES, damaged
from cavmarl.recordings.recording_format import arrow

KINDS = ("observations", "samples", "messages", "commands")


@dataclass(frozen=True)
class RecordOptions:
    """Options of `record`, as an alternative to a path.

    Attributes:
        path: a new folder.
        include: additional tables to record: `observations`, `samples`, `messages` or `commands`.
    """

    path: str | Path
    include: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in self.include:
            if name not in KINDS:
                raise ConfigError(f"record: include {name!r}: must be of {', '.join(KINDS)}")

    @classmethod
    def of(cls, record: Self | str | Path) -> RecordOptions:
        """Return options unchanged, or make options from a path."""
        return record if isinstance(record, RecordOptions) else cls(record)

    def at(self, path: str | Path) -> RecordOptions:
        """Return the same options with another path."""
        return RecordOptions(path, self.include)


class ExtraRows(NamedTuple):
    """Rows of one table that belong to one frame."""

    episode: int
    rows: NDArray[np.void]


def extra_table(parts: Sequence[ExtraRows], dtype: np.dtype[Any]) -> Any:
    """Build a table of the rows of some frames; rows from before a reset have their own part."""
    pa = arrow()
    rows = np.concatenate([np.zeros(0, dtype), *(part.rows for part in parts)])
    counts = [len(part.rows) for part in parts]
    episodes = np.repeat(np.array([part.episode for part in parts], np.int32), counts)
    columns = {"episode": pa.array(episodes, pa.int32())}
    for name in dtype.names or ():
        column, base, shape = np.ascontiguousarray(rows[name]), dtype[name].base, dtype[name].shape
        if base.kind == "O":
            columns[name] = pa.array(column.tolist(), pa.string())
        elif not shape:
            columns[name] = pa.array(column)
        elif base == np.float32:
            flat = pa.array(column.reshape(-1))
            columns[name] = pa.FixedSizeListArray.from_arrays(flat, int(np.prod(shape)))
        else:
            size = base.itemsize * int(np.prod(shape))
            buffers = [None, pa.py_buffer(column.tobytes())]
            kind = pa.binary(size)
            columns[name] = pa.FixedSizeBinaryArray.from_buffers(kind, len(rows), buffers)
    return pa.table(columns)


def extra_schema(dtype: np.dtype[Any]) -> Any:
    """Return the Arrow schema of a table of rows of a dtype."""
    pa = arrow()
    fields = [("episode", pa.int32())]
    for name in dtype.names or ():
        base, count = dtype[name].base, int(np.prod(dtype[name].shape))
        if base.kind == "O":
            fields.append((name, pa.string()))
        elif not dtype[name].shape:
            fields.append((name, pa.from_numpy_dtype(base)))
        elif base == np.float32:
            fields.append((name, pa.list_(pa.float32(), count)))
        else:
            fields.append((name, pa.binary(base.itemsize * count)))
    return pa.schema(fields)


def extra_rows(path: Path, table: Any, dtype: np.dtype[Any]) -> tuple[Any, NDArray[np.void]]:
    """Return (episodes (n,), rows (n,)) of a table with an `extra_schema`.

    Raises RecordingError: the rows need too much memory.
    """
    if table.num_rows * dtype.itemsize > MOST_BYTES:
        raise damaged(path, f"it has {table.num_rows} rows of {dtype.itemsize} bytes")
    rows = np.zeros(table.num_rows, dtype)
    for name in dtype.names or ():
        column = table.column(name).combine_chunks()
        base, shape = dtype[name].base, (len(rows), *dtype[name].shape)
        if base.kind == "O":
            rows[name] = column.to_pylist()
        elif len(shape) == 1:
            rows[name] = column.to_numpy(zero_copy_only=False)
        elif base == np.float32:
            flat = column.flatten().to_numpy(zero_copy_only=False)
            rows[name] = flat.reshape(shape)
        else:
            rows[name] = np.frombuffer(b"".join(column.to_pylist()), base).reshape(shape)
    return table.column("episode").to_numpy(), rows


def take_rows(extras: Mapping[str, NDArray[np.void]], episode: int, tick: int) -> Any:
    """Yield (table, `ExtraRows`) of a frame.

    If the world has restarted in this step, the frame is the first of the new episode. Rows with a
    larger tick than the frame were made before the restart and belong to the previous episode.
    """
    for name, rows in extras.items():
        late = rows["tick"] > tick
        if late.any():
            yield name, ExtraRows(max(0, episode - 1), rows[late])
            rows = rows[~late]
        yield name, ExtraRows(episode, rows)
