"""Damaged and forged recordings."""

from __future__ import annotations

import hashlib
import json
import random
import resource
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pyarrow as pa
import pyarrow.parquet as pq

from cavmarl import RecordOptions, parallel_env
from cavmarl.recordings.offline_data import TABLE, recorded_trips, settings_of
from cavmarl.recordings.recording import Recording
from cavmarl.recordings.recording_exports import EXPORTS
from cavmarl.recordings.replay_pictures import ReplayPictures
from cavmarl.roads.cache import pack_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.viewer.frame_messages import FrameEncoder
from cavmarl.viewer.live_recording import ShownRecording, recording_stages
from cavmarl.viewer.map_geometry import map_origin
from cavmarl.viewer.vehicle_details import vehicle_state
from fuzz.mutations import mutated

MEMORY_BYTES = 3 << 30  # additional address space for reading a recording
_ODD_NUMBERS = (
    0, -1, 1, -2, 127, 2**15 - 1, -(2**15), 2**31 - 1, -(2**31), 2**32, 2**53, 2**63 - 1,
    -(2**63), 0.5, -0.0, float("nan"), float("inf"), float("-inf"), 1e300, 1e13, 5e-324,
)  # fmt: skip
_ODD_TEXTS = ("", "x" * 5000, "\x00", "zone", "é" * 100)
_ODD_VALUES = (*_ODD_NUMBERS, *_ODD_TEXTS, None, True, [], {}, [[]], [0] * 300, 10**400)


def make_recording(path: Path, steps: int = 5) -> Path:
    """Record a small divided world with all kinds of data."""
    options = RecordOptions(path, include=("observations", "samples", "messages"))
    rig = {"lidar": {"type": "lidar", "rate_hz": 5.0, "rays": 8}}
    world: dict[str, Any] = {"zones": 2, "agents": 2, "background": 4, "overrides": {"rig": rig}}
    with closing(parallel_env("merge", record=options, **world)) as env:
        env.reset(seed=1)
        for _ in range(steps):
            env.step(env.suggest_actions())
    return path


@dataclass(frozen=True)
class Use:
    """The parts of the package that a test uses on a recording, in addition to the reader."""

    pictures: bool = False
    page: bool = False

    def read(self, path: Path, scratch: Path) -> None:
        """Read all data of a recording, and use it as `use` says."""
        recording = Recording.open(path)
        network = recording.network
        for world in recording.worlds:
            for episode in recording.episodes(world):
                for name, export in EXPORTS.items():
                    export(recording, scratch / name, world, episode, iter)
                frames = list(recording.frames(world, episode))
                for frame in frames:
                    recording.check_on_map(frame)
                for table in recording.extras:
                    recording.extra(table, world, episode)
                if TABLE in recording.extras:
                    settings_of(recording)
                    list(recorded_trips(recording))
                if self.pictures:
                    _draw(recording, frames)
                encoder = FrameEncoder(map_origin(network))
                for frame in frames:
                    encoder.publication(frame, ghosts_of=(0, 1))
                    for vehicle in frame.vehicles["id"].tolist():
                        vehicle_state(network, [], frame, vehicle)
        if self.page:
            for world, episode, stage in recording_stages(recording):
                shown = ShownRecording(recording, world, episode, stage)
                for tick in recording.ticks(world, episode):
                    frame = recording.at(tick, world, episode)
                    for vehicle in frame.vehicles["id"].tolist():
                        json.dumps(shown._details(frame, vehicle, True))


def _draw(recording: Recording, frames: list[Any]) -> None:
    pictures = ReplayPictures(recording)
    with closing(pictures):
        for frame in frames[:2]:
            pictures.picture(frame)


@contextmanager
def limited_memory(size: int = MEMORY_BYTES) -> Iterator[None]:
    """Limit the memory that this process can allocate within the block."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    present = psutil.Process().memory_info().vms
    resource.setrlimit(resource.RLIMIT_AS, (present + size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


class Forger:
    """Writes changed copies of a recording; most of each copy stays valid."""

    def __init__(self, good: Path, folder: Path, seed: int) -> None:
        self._rng = random.Random(seed)
        self._files = {
            file.relative_to(good): file.read_bytes() for file in good.rglob("*") if file.is_file()
        }
        self._tables = {
            file: pq.read_table(pa.BufferReader(content))
            for file, content in self._files.items()
            if file.suffix == ".parquet"
        }
        self._network = Recording.open(good).network
        self.path = folder / "forged"
        self._write(self._files)

    def forge(self) -> str:
        """Write another forged recording to `path`; return a description of the change."""
        self._write(self._files)
        kinds: list[Callable[[], str]] = [
            self._spoil_bytes, self._spoil_bytes, self._change_table, self._change_table,
            self._change_table, self._change_head, self._change_map,
        ]  # fmt: skip
        return self._rng.choice(kinds)()

    def _write(self, files: dict[Path, bytes]) -> None:
        for name, content in files.items():
            file = self.path / name
            file.parent.mkdir(parents=True, exist_ok=True)
            if not file.exists() or file.read_bytes() != content:
                file.write_bytes(content)

    def _spoil_bytes(self) -> str:
        rng = self._rng
        name = rng.choice(sorted(self._tables))
        content = bytearray(self._files[name])
        if rng.random() < 0.5:  # a file without checksums tests the other checks of the reader
            content = bytearray(_parquet(self._tables[name], rng))
        start = max(0, len(content) - 3000) if rng.random() < 0.6 else 0
        for _ in range(rng.randint(1, 4)):
            at = rng.randrange(start, len(content))
            match rng.randrange(4):
                case 0:
                    content[at] ^= 1 << rng.randrange(8)
                case 1:
                    content[at] = rng.choice((0, 1, 127, 128, 255))
                case 2:
                    del content[at : at + rng.randint(1, 9)]
                case _:
                    content[at:at] = bytes(rng.randrange(256) for _ in range(rng.randint(1, 9)))
            start = min(start, len(content) - 1)
        (self.path / name).write_bytes(content)
        return f"bytes of {name}"

    def _change_table(self) -> str:
        rng = self._rng
        name = rng.choice(sorted(self._tables))
        table = self._tables[name]
        columns = list(table.column_names)
        column = rng.choice(columns)
        match rng.randrange(9):
            case 0:
                table = table.drop_columns([column])
            case 1:
                other = rng.choice(columns)
                names = [{column: other, other: column}.get(one, one) for one in columns]
                table = table.rename_columns(names)
            case 2:
                table = table.slice(rng.randrange(table.num_rows + 1), rng.randrange(40))
            case 3:
                table = pa.concat_tables([table] * rng.randint(2, 3))
            case _ if table.num_rows:
                rows = table.column(column).to_pylist()
                at = rng.randrange(len(rows))
                rows[at] = self._odd(rows[at])
                kind = table.schema.field(column).type
                try:
                    array = pa.array(rows, kind)
                except (pa.ArrowException, OverflowError, TypeError, ValueError):
                    array = pa.nulls(len(rows), kind)
                table = table.set_column(columns.index(column), column, array)
        (self.path / name).write_bytes(_parquet(table, rng))
        return f"{column} of {name}"

    def _odd(self, value: Any) -> Any:
        rng = self._rng
        if isinstance(value, list) and value and rng.random() < 0.8:
            at = rng.randrange(len(value))
            return [*value[:at], self._odd(value[at]), *value[at + 1 :]]
        if isinstance(value, dict) and value:
            key = rng.choice(sorted(value))
            return {**value, key: self._odd(value[key])}
        if isinstance(value, bool) or not isinstance(value, int | float):
            return rng.choice(_ODD_VALUES)
        return rng.choice(_ODD_NUMBERS) if rng.random() < 0.7 else type(value)(value + 1)

    def _change_head(self) -> str:
        rng, name = self._rng, Path("recording.json")
        if rng.random() < 0.3:
            (self.path / name).write_bytes(mutated(self._files[name], rng))
            return "text of the head"
        head = json.loads(self._files[name])
        key = rng.choice(sorted(head))
        head[key] = self._odd_json(head[key])
        (self.path / name).write_text(json.dumps(head))
        return f"{key} of the head"

    def _odd_json(self, value: Any) -> Any:
        rng = self._rng
        if isinstance(value, dict) and value and rng.random() < 0.9:
            key = rng.choice(sorted(value))
            return {**value, key: self._odd_json(value[key])}
        if isinstance(value, list) and value and rng.random() < 0.9:
            at = rng.randrange(len(value))
            return [*value[:at], self._odd_json(value[at]), *value[at + 1 :]]
        return rng.choice(_ODD_VALUES)

    def _change_map(self) -> str:
        rng = self._rng
        tables = [
            name
            for name, value in vars(self._network).items()
            if isinstance(value, np.ndarray) and value.size and name not in ("joined", "walls")
        ]
        name = rng.choice(sorted(tables))
        rows = getattr(self._network, name).copy()
        column = rng.choice(rows.dtype.names) if rows.dtype.names else None
        values = rows[column] if column else rows
        at = rng.randrange(len(values.reshape(-1)))
        number = rng.choice(_ODD_NUMBERS)
        with np.errstate(all="ignore"):
            values.reshape(-1)[at] = np.asarray(number).astype(values.dtype)
        put_map(self.path, replace(self._network, **{name: rows}))
        return f"{column} of {name} of the map"


def put_map(path: Path, network: RoadNetwork) -> None:
    """Replace the map of a recording, and the checksum of the map in the head."""
    content = pack_network(network)
    head = json.loads((path / "recording.json").read_text())
    head["network"]["sha256"] = hashlib.sha256(content).hexdigest()
    (path / "network.bin").write_bytes(content)
    (path / "recording.json").write_text(json.dumps(head))


def _parquet(table: pa.Table, rng: random.Random) -> bytes:
    sink = pa.BufferOutputStream()
    compression = rng.choice(("lz4", "none", "snappy"))
    pq.write_table(
        table, sink, compression=compression, use_dictionary=rng.random() < 0.5,
        write_page_checksum=rng.random() < 0.5,
    )  # fmt: skip
    return bytes(sink.getvalue())
