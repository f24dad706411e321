"""`RecordingWriter`: writes frames to disk during a run, in parts that are committed atomically."""

from __future__ import annotations

import hashlib
import os
import threading
import time
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.atomic_file import write_whole
from cavmarl.core.errors import RecordingError
from cavmarl.core.processes import is_fork, refuse_fork
from cavmarl.engine.world_frame import FrameEvent, WorldFrame, events_between
from cavmarl.recordings.extra_tables import ExtraRows, extra_table, take_rows
from cavmarl.recordings.frame_memory import FrameMemory
from cavmarl.recordings.recording_format import (
    HEAD_FILE,
    NETWORK_FILE,
    TABLES,
    RecordedEvent,
    RecordedFrame,
    RecordingHead,
    arrow,
    columns_of,
    event_table,
    frame_table,
    vehicle_table,
    write_table,
)
from cavmarl.roads.cache import network_layout, pack_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_partition import ZonePartition

COMMIT_S = 0.8  # wall time between parts, so that each frame is on disk within a second
MOST_WAITING_BYTES = 256 << 20  # size of unwritten frames above which `add` waits


class RecordingWriter:
    """Takes frames and writes them in a thread, parallel to the run.

    About once per second, the new frames are committed as a part. If the process is killed or power
    fails, all committed parts remain. Without `close`, the rest is written when the process ends.

    Args:
        path: a folder to create; it may exist if it is empty.
        environment: name and version of the environment.
        network: the map, which is copied into the recording.
        partition: the zones.
        halo_m: sensing range of zones over their borders.
        sim_dt_s: seconds per tick.
        step_s: seconds per step.
        manifest: manifest of the run, with the key `world`; has numbers, text, lists and dicts.
        extras: dtypes of the optional tables, by name; their first field is `tick`.
        features: sensor and name of each observed number, if observations are recorded.
        terms: names of the reward terms, if observations are recorded.

    Attributes:
        memory: for the rows of frames that only this writer reads; it is used again once they are
            written.

    Raises:
        RecordingError: `path` exists and is not empty, or cannot be written.
        MissingExtraError: pyarrow is not installed.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        environment: str,
        network: RoadNetwork,
        partition: ZonePartition,
        halo_m: float,
        sim_dt_s: float,
        step_s: float,
        manifest: Mapping[str, Any],
        extras: Mapping[str, np.dtype[Any]] | None = None,
        features: Sequence[Sequence[str]] = (),
        terms: Sequence[str] = (),
    ) -> None:
        arrow()
        self.path = Path(path)
        packed = pack_network(network)
        head = RecordingHead(
            environment=environment,
            sim_dt_s=sim_dt_s,
            step_s=step_s,
            network={
                "name": network.name,
                "source_sha256": network.source_hash,
                "layout": network_layout(),
                "sha256": hashlib.sha256(packed).hexdigest(),
            },
            bounds=list(partition.bounds),
            rects=partition.rects.tolist(),
            halo_m=halo_m,
            manifest=manifest,
            extras={name: columns_of(dtype) for name, dtype in (extras or {}).items()},
            features=features,
            terms=terms,
        )
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if any(self.path.iterdir()):
                raise RecordingError(f"{path}: exists and is not empty; give a new folder")
            write_whole(self.path / NETWORK_FILE, packed)
            write_whole(self.path / HEAD_FILE, head.to_bytes())
        except OSError as error:
            raise _unwritable(self.path, error) from error
        self.memory = FrameMemory()
        self._sink = _Sink(self.path, head, dict(extras or {}), self.memory)
        self._finish = weakref.finalize(self, self._sink.close)  # also runs when the process ends

    def add(self, frames: Iterable[WorldFrame], extras: Iterable[Extras] = ()) -> None:
        """Add one frame per world; a tick at or below the world's last tick begins an episode.

        Args:
            frames: frames of worlds.
            extras: rows of the optional tables of each frame, by name.

        Raises:
            RecordingError: an earlier part could not be written.
        """
        none: Extras = {}
        these, more = list(frames), list(extras)
        self._sink.add(list(zip(these, more or [none] * len(these), strict=True)))

    def add_rows(self, world: int, extras: Extras) -> None:
        """Add rows of the optional tables to the last episode of a world, without a frame.

        Raises:
            RecordingError: an earlier part could not be written.
        """
        if extras:
            self._sink.add([(world, extras)])

    def close(self) -> None:
        """Write the remaining frames and mark the recording as closed.

        Raises:
            RecordingError: a part could not be written.
        """
        if self._finish.alive:
            self._finish.detach()
            self._sink.close()
            self._sink.check()


Extras = Mapping[str, NDArray[np.void]]
_Moment = tuple[WorldFrame | int, Extras]  # a frame or, for rows without a frame, a world


class _Sink:
    """The state of the writing thread; it does not keep the writer alive."""

    def __init__(
        self,
        path: Path,
        head: RecordingHead,
        extras: Mapping[str, np.dtype[Any]],
        memory: FrameMemory,
    ) -> None:
        self._path = path
        self._memory = memory
        self._head = head
        self._extras = extras
        self._pid = os.getpid()  # a forked process does not have the writing thread
        self._waiting: list[_Moment] = []
        self._waiting_bytes = 0
        self._changed = threading.Condition()
        self._closing = False
        self._error: Exception | None = None
        self._worlds: dict[int, _WorldParts] = {}
        self._thread: threading.Thread | None = None

    def add(self, moments: Sequence[_Moment]) -> None:
        refuse_fork(self._pid, f"the frames of {self._path}")
        self.check()
        size = sum(
            (frame.vehicles.nbytes if isinstance(frame, WorldFrame) else 0)
            + sum(rows.nbytes for rows in extras.values())
            for frame, extras in moments
        )
        with self._changed:
            self._waiting += moments
            self._waiting_bytes += size
            if self._thread is None:  # started as late as possible, since worlds may fork first
                self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
                self._thread.start()
            if self._waiting_bytes > MOST_WAITING_BYTES:
                self._changed.notify_all()
                self._changed.wait_for(lambda: not self._waiting or self._error is not None)

    def check(self) -> None:
        if self._error is not None:
            raise _unwritable(self._path, self._error) from self._error

    def close(self) -> None:
        if is_fork(self._pid):
            return
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()
        if self._error is None:
            try:
                write_whole(self._path / HEAD_FILE, self._head.closed().to_bytes())
            except OSError as error:
                self._error = error

    def _run(self) -> None:
        due = time.monotonic() + COMMIT_S
        while True:
            with self._changed:
                self._changed.wait_for(self._is_due, timeout=max(0.0, due - time.monotonic()))
                moments, self._waiting, self._waiting_bytes = self._waiting, [], 0
                last = self._closing
                self._changed.notify_all()
            due = time.monotonic() + COMMIT_S
            try:
                self._commit(moments)
            except Exception as error:  # raised again in `add`
                with self._changed:
                    self._error = error
                    self._changed.notify_all()
                return
            if last:
                return

    def _is_due(self) -> bool:
        return self._closing or self._waiting_bytes > MOST_WAITING_BYTES

    def _commit(self, moments: Sequence[_Moment]) -> None:
        for frame, extras in moments:
            if not isinstance(frame, WorldFrame):
                self._worlds[frame].take_rows(extras)
                continue
            if frame.world not in self._worlds:
                folder = self._path / f"world-{frame.world}"
                self._worlds[frame.world] = _WorldParts(
                    folder, self._head, self._extras, self._memory
                )
            self._worlds[frame.world].take(frame, extras)
        for parts in self._worlds.values():
            parts.commit()


class _WorldParts:
    """The parts of one world."""

    def __init__(
        self,
        folder: Path,
        head: RecordingHead,
        extras: Mapping[str, np.dtype[Any]],
        memory: FrameMemory,
    ) -> None:
        self._folder = folder
        self._memory = memory
        self._dtypes = extras
        self._extras: dict[str, list[ExtraRows]] = {name: [] for name in extras}
        self._step_ticks = max(1, round(head.step_s / head.sim_dt_s))
        self._count = 0
        self._last: RecordedFrame | None = None
        self._frames: list[RecordedFrame] = []
        self._events: list[RecordedEvent] = []
        for table in (*extras, *TABLES):
            (folder / table).mkdir(parents=True)

    def take(self, frame: WorldFrame, extras: Extras) -> None:
        last = self._last
        episode = 0 if last is None else last.episode
        if last is not None and frame.tick <= last.frame.tick:
            self._events += (
                RecordedEvent(episode, event) for event in self._at_the_end(last.frame, frame)
            )
            episode += 1
        elif last is not None:
            found = events_between(last.frame, frame)
            self._events += (RecordedEvent(episode, event) for event in found)
        if last is not None and not self._frames:  # the last frame is committed already
            self._memory.give_back(last.frame.vehicles)
        self._last = RecordedFrame(episode, frame)
        self._frames.append(self._last)
        for name, rows in take_rows(extras, episode, frame.tick):
            self._extras[name].append(rows)

    def take_rows(self, extras: Extras) -> None:
        """Add rows to the last episode."""
        assert self._last is not None
        for name, rows in extras.items():
            self._extras[name].append(ExtraRows(self._last.episode, rows))

    def _at_the_end(self, last: WorldFrame, first: WorldFrame) -> Iterator[FrameEvent]:
        """Yield the events of an episode's last step, which has no frame: the world restarted."""
        ended = first.ended["agent"]
        stay = last.vehicles[~np.isin(last.vehicles["agent"], ended) | (last.vehicles["agent"] < 0)]
        stay = stay.copy()
        stay["events"] = 0
        over = last._replace(
            tick=last.tick + self._step_ticks,
            vehicles=stay,
            ended=first.ended,
            transfers=(),
            asked=first.asked,
        )
        return events_between(last, over)

    def commit(self) -> None:
        """Write a part, unless it is empty; its frames are written last and commit it."""
        if not self._frames and not any(self._extras.values()):
            return
        tables = {
            name: extra_table(rows, self._dtypes[name]) for name, rows in self._extras.items()
        }
        tables["vehicles"] = vehicle_table(self._frames)
        tables["events"] = event_table(self._events)
        tables["frames"] = frame_table(self._frames)
        for name, table in tables.items():
            write_whole(self._folder / name / f"{self._count:06d}.parquet", write_table(table))
        self._count += 1
        for recorded in self._frames[:-1]:
            self._memory.give_back(recorded.frame.vehicles)
        self._frames, self._events = [], []
        self._extras = {name: [] for name in self._dtypes}


def _unwritable(path: Path, error: Exception) -> RecordingError:
    reason = error.strerror if isinstance(error, OSError) and error.strerror else error
    return RecordingError(
        f"{path}: cannot record there ({reason}); committed parts stay readable; free space, "
        "or record into another folder"
    )
