"""`Recording`: what `RecordingWriter` wrote, to read."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import RecordingError
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.recordings.extra_tables import extra_rows
from cavmarl.recordings.recording_format import (
    HEAD_FILE,
    NETWORK_FILE,
    RecordedEvent,
    RecordedFrame,
    RecordingHead,
    damaged,
    dtype_of,
    events_of,
    frames_of,
    read_table,
)
from cavmarl.roads.cache import network_layout, unpack_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_partition import ZonePartition

_INDEX = np.dtype([("episode", "<i4"), ("tick", "<i8"), ("part", "<i4"), ("row", "<i4")])


class Recording:
    """A recording; it is read part by part, as it is asked for.

    One that is still written, or whose run was killed, has what was committed when it was opened.

    Args:
        path: the folder that `record` was given.

    Attributes:
        path: likewise.
        head: what it is.
        worlds: their numbers.

    Raises:
        RecordingError: no recording, a damaged one, or one of another version.
        MissingExtraError: pyarrow is not installed.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.head = RecordingHead.read(self.path)
        self._parts = {
            number: parts
            for folder in self.path.glob("world-*")
            if (number := _number(folder.name.removeprefix("world-"))) is not None
            and (parts := _parts_of(folder))
        }
        self.worlds = sorted(self._parts)
        self._kept: tuple[Path | None, list[RecordedFrame]] = (None, [])
        self._kept_extras: dict[str, tuple[Path, Any]] = {}  # by table: its part that was read last
        self._indices: dict[int, NDArray[np.void]] = {}

    @classmethod
    def open(cls, path: str | Path) -> Recording:
        """As the class itself."""
        return cls(path)

    @property
    def is_whole(self) -> bool:
        """Whether it was closed in order: False of one that is written, or whose run was killed."""
        return self.head.status == "closed"

    @property
    def manifest(self) -> Mapping[str, Any]:
        """Of the run: its world, machine, packages and commit."""
        return self.head.manifest

    @property
    def partition(self) -> ZonePartition:
        """The zones."""
        return self.head.partition

    @cached_property
    def network(self) -> RoadNetwork:
        """The map.

        Raises:
            RecordingError: it is missing or damaged, or packed by another version.
        """
        path, told = self.path / NETWORK_FILE, self.head.network
        try:
            content = path.read_bytes()
        except OSError as error:
            raise RecordingError(
                f"{path}: the recording is without its map ({error.strerror or error}); put the "
                "file back, from another recording of the same map if need be"
            ) from error
        if told["layout"] != network_layout():
            raise RecordingError(
                f"{path}: the map is packed as layout {told['layout']}, but this version reads "
                f"{network_layout()}; use the version of cavmarl that wrote it"
            )
        whole = hashlib.sha256(content).hexdigest() == told["sha256"]
        network = unpack_network(content, told["name"], told["source_sha256"]) if whole else None
        if network is None:
            raise RecordingError(
                f"{path}: is not the map that {HEAD_FILE} tells of, or damaged; put the file "
                "back, from another recording of the same map if need be"
            )
        return network

    def episodes(self, world: int = 0) -> list[int]:
        """The numbers of the episodes of a world, from 0."""
        return [int(number) for number in np.unique(self._index(world)["episode"])]

    def ticks(self, world: int = 0, episode: int = 0) -> list[int]:
        """The ticks of an episode of which there are frames, in order."""
        index = self._index(world)
        return [int(tick) for tick in index["tick"][index["episode"] == episode]]

    def frames(self, world: int = 0, episode: int | None = None) -> Iterator[WorldFrame]:
        """All frames of a world, or of one episode, in order; equal to those that were recorded.

        Raises:
            RecordingError: no such world, or a part is missing or damaged.
        """
        for found in self.recorded(world):
            if episode is None or found.episode == episode:
                yield found.frame

    def recorded(self, world: int = 0) -> Iterator[RecordedFrame]:
        """All frames of a world with their episodes; raises as `frames`."""
        for path in self._paths(world):
            yield from self._read(path, world)

    def at(self, tick: int, world: int = 0, episode: int = 0) -> WorldFrame:
        """The last frame of an episode that is not after a tick.

        Raises:
            RecordingError: there is none, or a part is missing or damaged.
        """
        index = self._index(world)
        index = index[index["episode"] == episode]
        place = int(np.searchsorted(index["tick"], tick, side="right")) - 1
        if place < 0:
            raise RecordingError(
                f"{self.path}: no frame at tick {tick} of episode {episode} of world {world}; "
                f"there are the episodes {self.episodes(world)}"
            )
        found = index[place]
        return self._read(self._paths(world)[int(found["part"])], world)[int(found["row"])].frame

    def events(self, world: int = 0) -> Iterator[RecordedEvent]:
        """What happened in a world, in order; raises as `frames`."""
        for frames in self._paths(world):
            path = frames.parent.parent / "events" / frames.name
            yield from events_of(path, read_table(path))

    @property
    def extras(self) -> list[str]:
        """Names of the tables that were recorded on request."""
        return list(self.head.extras)

    def extra(self, table: str, world: int = 0, episode: int | None = None) -> NDArray[np.void]:
        """All rows of a table on request, of one world; of one episode, or of all.

        Raises:
            RecordingError: it was not recorded, or a part is missing or damaged.
        """
        rows = [np.zeros(0, self._dtype(table))]
        for frames in self._paths(world):
            episodes, found = self._extra_of(table, frames)
            rows.append(found if episode is None else found[episodes == episode])
        return np.concatenate(rows)

    def extra_at(self, table: str, tick: int, world: int = 0, episode: int = 0) -> Any:
        """The rows (n,) of a table on request of one tick of which there is a frame.

        Raises:
            RecordingError: it was not recorded, or a part is missing or damaged.
        """
        index = self._index(world)
        parts = index["part"][(index["episode"] == episode) & (index["tick"] == tick)]
        if not len(parts):
            return np.zeros(0, self._dtype(table))
        episodes, rows = self._extra_of(table, self._paths(world)[int(parts[0])])
        return rows[(episodes == episode) & (rows["tick"] == tick)]

    def _dtype(self, table: str) -> np.dtype[Any]:
        columns = self.head.extras.get(table)
        if columns is None:
            there = ", ".join(self.head.extras) or "none"
            raise RecordingError(
                f"{self.path}: has no {table}; it has {there}: record with "
                f"RecordOptions(path, include=(…,)) or --record-also"
            )
        return dtype_of(columns)

    def _extra_of(self, table: str, frames: Path) -> tuple[Any, NDArray[np.void]]:
        """(episodes, rows) of the table of a part; the last one that was read is kept."""
        dtype = self._dtype(table)
        path = frames.parent.parent / table / frames.name
        kept = self._kept_extras.get(table)
        if kept is None or kept[0] != path:
            kept = path, extra_rows(path, read_table(path), dtype)
            self._kept_extras[table] = kept
        found: tuple[Any, NDArray[np.void]] = kept[1]
        return found

    def _paths(self, world: int) -> list[Path]:
        """The committed parts of a world: the files of their frames."""
        if world not in self._parts:
            there = ", ".join(map(str, self.worlds)) or "none: nothing was committed"
            raise RecordingError(f"{self.path}: no world {world}; there are {there}")
        return self._parts[world]

    def _index(self, world: int) -> NDArray[np.void]:
        if world not in self._indices:
            rows = [np.zeros(0, _INDEX)]
            for part, path in enumerate(self._paths(world)):
                table = read_table(path)
                one = np.zeros(table.num_rows, _INDEX)
                try:
                    for name in ("episode", "tick"):
                        one[name] = table.column(name).to_numpy()
                except (KeyError, ValueError) as error:
                    raise damaged(path, str(error)) from error
                one["part"], one["row"] = part, np.arange(len(one))
                rows.append(one)
            self._indices[world] = np.concatenate(rows)
        return self._indices[world]

    def _read(self, path: Path, world: int) -> list[RecordedFrame]:
        """The frames of a part; the last one that was read is kept."""
        if self._kept[0] != path:
            vehicles = read_table(path.parent.parent / "vehicles" / path.name)
            self._kept = path, frames_of(path, world, read_table(path), vehicles)
        return self._kept[1]


def _number(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdecimal() else None


def _parts_of(folder: Path) -> list[Path]:
    """The committed parts of a world, in order.

    Raises:
        RecordingError: one in between is missing.
    """
    paths = sorted(path for path in (folder / "frames").glob("*.parquet") if path.name[0] != ".")
    for number, path in enumerate(paths):
        if path.stem != f"{number:06d}":
            raise RecordingError(
                f"{path.with_name(f'{number:06d}.parquet')}: is missing, though later parts are "
                "there; restore it, or take the later ones away to read what is before"
            )
    return paths
