"""Recordings on the page: play, pause and seek; errors of incomplete recordings."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from cavmarl.core.errors import RecordingError
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.env.vector import make_vec
from cavmarl.recordings.extra_tables import RecordOptions
from cavmarl.recordings.recording import Recording
from cavmarl.viewer.frame_messages import FRAME_HEAD, Publication
from cavmarl.viewer.live_recording import ShownRecording, recording_stages
from cavmarl.viewer.page_requests import PageRequest

STEPS = 30


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record two divided worlds with thirty steps each."""
    folder = tmp_path_factory.mktemp("recorded") / "run"
    record = RecordOptions(folder, ("observations",))
    vec = make_vec("grid4x4", num_envs=2, zones=2, agents=2, background=6, record=record)
    vec.reset(seed=0)
    for _ in range(STEPS):
        vec.step(vec.suggest_actions())
    vec.close()
    return folder


@pytest.fixture
def loop() -> Iterator[asyncio.AbstractEventLoop]:
    """An event loop in place of the server's; each turn runs the calls that wait in it."""
    with closing(asyncio.new_event_loop()) as made:
        yield made


class RecordingWatcher:
    """A watcher of one world of a recording, without a server."""

    def __init__(self, path: Path, loop: asyncio.AbstractEventLoop, world: int = 1) -> None:
        recording = Recording(path)
        (found,) = [one for one in recording_stages(recording) if one[:2] == (world, 0)]
        self.stage = found[2]
        self.shown = ShownRecording(recording, *found)
        self._loop = loop
        self.stage.audience.begin(loop)
        self.watcher = self.stage.audience.join()

    def ask(self, kind: str, number: float | None = None) -> None:
        self.stage.audience.ask(self.watcher, PageRequest(kind, number, sensors=True))

    def turn(self) -> tuple[int, bool] | None:
        """Return the tick of the newest frame, and whether the recording is paused."""
        time.sleep(0.06)
        self.shown.turn()
        self._loop.run_until_complete(asyncio.sleep(0.0))
        newest: Publication | None = self.watcher.newest
        self.watcher.newest = None
        if newest is None:
            return None
        head = FRAME_HEAD.unpack_from(newest.frame)
        return head[5], bool(head[1])

    def details_of(self, vehicle: int, tick: int) -> Any:
        """Return the details of a vehicle at a tick."""
        self.ask("pause")
        self.ask("seek", tick)
        self.ask("watch", vehicle)
        self.watcher.texts.clear()
        turns(self, lambda found: found[0] == tick)
        (told,) = (
            each for each in map(json.loads, self.watcher.texts) if each["kind"] == "vehicle"
        )
        return told


def turns(watcher: RecordingWatcher, is_so: Callable[[tuple[int, bool]], bool]) -> tuple[int, bool]:
    for _ in range(100):
        found = watcher.turn()
        if found is not None and is_so(found):
            return found
    raise AssertionError("no such frame came")


def test_a_recording_plays_to_its_end_pauses_and_restarts(
    path: Path, loop: asyncio.AbstractEventLoop
) -> None:
    watcher = RecordingWatcher(path, loop)
    watcher.ask("pace", 10.0)
    first, last = watcher.stage.hello["span"]
    assert turns(watcher, lambda found: True)[0] < last
    assert turns(watcher, lambda found: found[1]) == (last, True)
    watcher.ask("play")
    assert turns(watcher, lambda found: not found[1])[0] < last
    assert first < last


def test_a_page_can_seek_any_tick(path: Path, loop: asyncio.AbstractEventLoop) -> None:
    watcher = RecordingWatcher(path, loop)
    watcher.ask("pause")
    ticks = Recording(path).ticks(1, 0)
    for wanted, shown in ((ticks[17] + 1, ticks[17]), (0, ticks[0]), (10**9, ticks[-1])):
        watcher.ask("seek", wanted)
        assert turns(watcher, lambda found: True) == (shown, True)


def test_a_vehicle_is_shown_as_recorded(path: Path, loop: asyncio.AbstractEventLoop) -> None:
    watcher = RecordingWatcher(path, loop, world=0)
    frame: WorldFrame = Recording(path).at(10, 0, 0)
    row = frame.vehicles[0]
    found = watcher.details_of(int(row["id"]), frame.tick)
    assert found["here"]
    assert dict(found["rows"])["speed"].startswith(f"{row['speed']:.2f} m/s")
    assert not watcher.details_of(10**6, frame.tick)["here"]


def test_an_agent_is_shown_with_its_observation(
    path: Path, loop: asyncio.AbstractEventLoop
) -> None:
    watcher, recording = RecordingWatcher(path, loop, world=1), Recording(path)
    tick = recording.ticks(1, 0)[5]
    frame = recording.at(tick, 1, 0)
    row = recording.extra_at("observations", tick, 1)[0]
    found = watcher.details_of(int(row["vehicle"]), tick)
    names = [tuple(told[:2]) for told in found["observation"]]
    assert names == [tuple(name) for name in recording.head.features]
    numbers = [told[2] for told in found["observation"]]
    assert numbers == pytest.approx(row["values"].tolist(), abs=1e-4)
    assert [name for name, _ in found["terms"]] == list(recording.head.terms)
    others = frame.vehicles[frame.vehicles["agent"] < 0]
    assert "observation" not in watcher.details_of(int(others["id"][0]), tick)


def test_a_recording_without_a_map_or_frames_is_refused(path: Path, tmp_path: Path) -> None:
    (path / "network.bin").rename(tmp_path / "network.bin")
    try:
        with pytest.raises(RecordingError, match="has no map"):
            recording_stages(Recording(path))
    finally:
        (tmp_path / "network.bin").rename(path / "network.bin")
    empty = tmp_path / "empty"
    empty.mkdir()
    for name in ("recording.json", "network.bin"):
        (empty / name).write_bytes((path / name).read_bytes())
    with pytest.raises(RecordingError, match="the recording has no frames"):
        recording_stages(Recording(empty))
