"""`Recording`: reads the recordings of a `RecordingWriter`."""

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
from cavmarl.recordings.extra_tables import extra_rows, extra_schema
from cavmarl.recordings.frame_check import wrong_on_map
from cavmarl.recordings.part_files import damaged, read_file, read_table
from cavmarl.recordings.recording_format import (
    HEAD_FILE,
    NETWORK_FILE,
    RecordedEvent,
    RecordedFrame,
    RecordingHead,
    dtype_of,
    event_schema,
    events_of,
    frame_schema,
    frames_of,
    vehicle_schema,
)
from cavmarl.roads.cache import network_layout, unpack_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.network_check import wrong_network
from cavmarl.zones.partition.zone_partition import ZonePartition

MOST_DIGITS = 9  # limit of the digits of a world's number
_INDEX = np.dtype([("episode", "<i4"), ("tick", "<i8"), ("part", "<i4"), ("row", "<i4")])


def recordings_in(folder: Path) -> list[Path]:
    """Return the recordings at most three levels below a folder that is not itself a recording."""
    if (folder / HEAD_FILE).is_file():
        return []
    found = [file for depth in (1, 2, 3) for file in folder.glob(f"{'*/' * depth}{HEAD_FILE}")]
    return sorted(file.parent for file in found)


class Recording:
    """A recording, read part by part on demand.

    If the recording is still being written, or its run was killed, only the parts that were
    committed when it was opened can be read.

    Args:
        path: the folder that was given to `record`.

    Attributes:
        path: the folder.
        head: the contents of `recording.json`.
        worlds: indices of its worlds.

    Raises:
        RecordingError: there is no recording, or it is damaged or of another version.
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
        self._kept_extras: dict[str, tuple[Path, Any]] = {}  # table → part that was read last
        self._indices: dict[int, NDArray[np.void]] = {}

    @classmethod
    def open(cls, path: str | Path) -> Recording:
        """Open a recording; the same as calling the class."""
        return cls(path)

    @property
    def is_whole(self) -> bool:
        """Return whether the recording was closed; False during its run, or if the run died."""
        return self.head.status == "closed"

    @property
    def manifest(self) -> Mapping[str, Any]:
        """The manifest of the run: its world, machine, packages and commit."""
        return self.head.manifest

    @property
    def partition(self) -> ZonePartition:
        return self.head.partition

    @cached_property
    def network(self) -> RoadNetwork:
        """The map.

        Raises:
            RecordingError: the map is missing or damaged, or has the layout of another version.
        """
        path, info = self.path / NETWORK_FILE, self.head.network
        try:
            content = read_file(path)
        except OSError as error:
            raise RecordingError(
                f"{path}: the recording has no map ({error.strerror or error}); put the "
                "file back, from another recording of the same map if need be"
            ) from error
        if info["layout"] != network_layout():
            raise RecordingError(
                f"{path}: the map has layout {info['layout']}, but this version reads "
                f"{network_layout()}; use the version of cavmarl that wrote it"
            )
        damage = RecordingError(
            f"{path}: is damaged, or not the map named in {HEAD_FILE}; put the file "
            "back, from another recording of the same map if need be"
        )
        if hashlib.sha256(content).hexdigest() != info["sha256"]:
            raise damage
        try:
            network = unpack_network(content, info["name"], info["source_sha256"])
            wrong = "" if network is None else wrong_network(network)
        except Exception as error:
            raise damage from error
        if network is None:
            raise damage
        if wrong:
            raise RecordingError(f"{path}: is damaged ({wrong}); get the recording again")
        return network

    def check_on_map(self, frame: WorldFrame) -> None:
        """Check that a frame can be drawn on the map.

        Raises:
            RecordingError: its signals do not match the map, or the map is missing or damaged.
        """
        if wrong := wrong_on_map(frame, self.network):
            raise RecordingError(f"{self.path}: does not fit its map ({wrong}); get it again")

    def episodes(self, world: int = 0) -> list[int]:
        """Return the indices of a world's episodes, from 0."""
        return [int(number) for number in np.unique(self._index(world)["episode"])]

    def ticks(self, world: int = 0, episode: int = 0) -> list[int]:
        """Return the ticks of an episode that have frames, in order."""
        index = self._index(world)
        return [int(tick) for tick in index["tick"][index["episode"] == episode]]

    def frames(self, world: int = 0, episode: int | None = None) -> Iterator[WorldFrame]:
        """Yield all frames of a world or of one episode, in order, as they were recorded.

        Raises:
            RecordingError: there is no such world, or a part is missing or damaged.
        """
        for found in self.recorded(world):
            if episode is None or found.episode == episode:
                yield found.frame

    def recorded(self, world: int = 0) -> Iterator[RecordedFrame]:
        """Yield all frames of a world with their episodes; errors as in `frames`."""
        for path in self._paths(world):
            yield from self._read(path, world)

    def at(self, tick: int, world: int = 0, episode: int = 0) -> WorldFrame:
        """Return the last frame of an episode at or before a tick.

        Raises:
            RecordingError: there is no such frame, or a part is missing or damaged.
        """
        index = self._index(world)
        index = index[index["episode"] == episode]
        place = int(np.searchsorted(index["tick"], tick, side="right")) - 1
        if place < 0:
            raise RecordingError(
                f"{self.path}: no frame at tick {tick} of episode {episode} of world {world}; "
                f"the episodes are {self.episodes(world)}"
            )
        found = index[place]
        return self._read(self._paths(world)[int(found["part"])], world)[int(found["row"])].frame

    def events(self, world: int = 0) -> Iterator[RecordedEvent]:
        """Yield the events of a world, in order; errors as in `frames`."""
        for frames in self._paths(world):
            path = frames.parent.parent / "events" / frames.name
            yield from events_of(read_table(path, event_schema()))

    @property
    def extras(self) -> list[str]:
        """Return the names of the optional tables that were recorded."""
        return list(self.head.extras)

    def extra(self, table: str, world: int = 0, episode: int | None = None) -> NDArray[np.void]:
        """Return all rows of an optional table, of one world and of one or all episodes.

        Raises:
            RecordingError: the table was not recorded, or a part is missing or damaged.
        """
        rows = [np.zeros(0, self._dtype(table))]
        for frames in self._paths(world):
            episodes, found = self._extra_of(table, frames)
            rows.append(found if episode is None else found[episodes == episode])
        return np.concatenate(rows)

    def extra_by_episode(
        self, table: str, world: int = 0
    ) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Yield the rows of an optional table episode by episode: (index of episode, rows).

        Only one episode is in memory at a time. Errors as in `extra`.
        """
        present, parts = 0, [np.zeros(0, self._dtype(table))]
        for frames in self._paths(world):
            episodes, found = self._extra_of(table, frames)
            for episode in np.unique(episodes).tolist():
                if episode != present:
                    yield present, np.concatenate(parts)
                    present, parts = episode, parts[:0]
                parts.append(found[episodes == episode])
        yield present, np.concatenate(parts)

    def extra_at(self, table: str, tick: int, world: int = 0, episode: int = 0) -> Any:
        """Return the rows (n,) of an optional table at one tick that has a frame.

        Raises:
            RecordingError: the table was not recorded, or a part is missing or damaged.
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
        """Return (episodes, rows) of a part's table; the last part is cached."""
        dtype = self._dtype(table)
        path = frames.parent.parent / table / frames.name
        kept = self._kept_extras.get(table)
        if kept is None or kept[0] != path:
            kept = path, extra_rows(path, read_table(path, extra_schema(dtype)), dtype)
            self._kept_extras[table] = kept
        found: tuple[Any, NDArray[np.void]] = kept[1]
        return found

    def _paths(self, world: int) -> list[Path]:
        """Return the frame files of the committed parts of a world."""
        if world not in self._parts:
            there = ", ".join(map(str, self.worlds)) or "none: nothing was committed"
            raise RecordingError(f"{self.path}: no world {world}; the worlds are {there}")
        return self._parts[world]

    def _index(self, world: int) -> NDArray[np.void]:
        if world not in self._indices:
            rows = [np.zeros(0, _INDEX)]
            for part, path in enumerate(self._paths(world)):
                table = read_table(path, frame_schema())
                one = np.zeros(table.num_rows, _INDEX)
                for name in ("episode", "tick"):
                    one[name] = table.column(name).to_numpy()
                one["part"], one["row"] = part, np.arange(len(one))
                last = rows[-1][-1:]
                moments = np.concatenate([last, one])[["episode", "tick"]]
                if not (np.sort(moments) == moments).all() or len(np.unique(moments)) < len(
                    moments
                ):
                    raise damaged(path, "its frames are not in order")
                rows.append(one)
            self._indices[world] = np.concatenate(rows)
        return self._indices[world]

    def _read(self, path: Path, world: int) -> list[RecordedFrame]:
        """Return the frames of a part; the last part is cached."""
        if self._kept[0] != path:
            vehicles = read_table(path.parent.parent / "vehicles" / path.name, vehicle_schema())
            frames = read_table(path, frame_schema())
            self._kept = path, frames_of(path, world, frames, vehicles, self.partition.count)
        return self._kept[1]


def _number(text: str) -> int | None:
    is_number = text.isascii() and text.isdecimal() and len(text) <= MOST_DIGITS
    return int(text) if is_number else None


def _parts_of(folder: Path) -> list[Path]:
    """Return the committed parts of a world, in order.

    Raises:
        RecordingError: a part in between is missing.
    """
    paths = sorted(path for path in (folder / "frames").glob("*.parquet") if path.name[0] != ".")
    for number, path in enumerate(paths):
        if path.stem != f"{number:06d}":
            raise RecordingError(
                f"{path.with_name(f'{number:06d}.parquet')}: is missing, although later parts "
                "exist; restore it, or remove the later parts to read the earlier ones"
            )
    return paths
