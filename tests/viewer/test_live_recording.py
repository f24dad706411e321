"""A recording on the page: played, paused, searched along its time line; and bad recordings."""

from __future__ import annotations

import time
from collections.abc import Callable
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
    """Two worlds, divided, thirty steps each."""
    folder = tmp_path_factory.mktemp("recorded") / "run"
    record = RecordOptions(folder, ("observations",))
    vec = make_vec("grid4x4", num_envs=2, zones=2, agents=2, background=6, record=record)
    vec.reset(seed=0)
    for _ in range(STEPS):
        vec.step(vec.suggest_actions())
    vec.close()
    return folder


class Heard:
    """A watcher of a stage, without a server."""

    def __init__(self, path: Path, world: int = 1) -> None:
        recording = Recording(path)
        (found,) = [one for one in recording_stages(recording) if one[:2] == (world, 0)]
        self.stage = found[2]
        self.shown = ShownRecording(recording, *found)
        self.events: list[Any] = []
        audience: Any = self.stage.audience
        audience._call = lambda function, *arguments: function(*arguments)
        self.watcher = audience.join()

    def ask(self, kind: str, number: float | None = None) -> None:
        self.stage.audience.ask(self.watcher, PageRequest(kind, number))

    def turn(self) -> tuple[int, bool] | None:
        """Tick of a frame that came, and whether it is paused."""
        time.sleep(0.06)
        self.shown.turn()
        newest: Publication | None = self.watcher.newest
        self.watcher.newest = None
        if newest is None:
            return None
        head = FRAME_HEAD.unpack_from(newest.frame)
        return head[5], bool(head[1])


def turns(heard: Heard, is_so: Callable[[tuple[int, bool]], bool]) -> tuple[int, bool]:
    for _ in range(100):
        found = heard.turn()
        if found is not None and is_so(found):
            return found
    raise AssertionError("it never came")


def test_it_plays_to_its_end_pauses_and_begins_again(path: Path) -> None:
    heard = Heard(path)
    heard.ask("pace", 10.0)
    first, last = heard.stage.hello["span"]
    assert turns(heard, lambda found: True)[0] < last
    assert turns(heard, lambda found: found[1]) == (last, True)
    heard.ask("play")
    assert turns(heard, lambda found: not found[1])[0] < last
    assert first < last


def test_a_page_goes_to_any_moment(path: Path) -> None:
    heard = Heard(path)
    heard.ask("pause")
    ticks = Recording(path).ticks(1, 0)
    for wanted, shown in ((ticks[17] + 1, ticks[17]), (0, ticks[0]), (10**9, ticks[-1])):
        heard.ask("seek", wanted)
        assert turns(heard, lambda found: True) == (shown, True)


def test_a_vehicle_is_told_as_it_was(path: Path) -> None:
    heard = Heard(path, world=0)
    frame: WorldFrame = Recording(path).at(10, 0, 0)
    row = frame.vehicles[0]
    found = heard.shown._details(frame, int(row["id"]), True)
    assert found["here"]
    assert dict(found["rows"])["speed"].startswith(f"{row['speed']:.2f} m/s")
    assert not heard.shown._details(frame, 10**6, True)["here"]


def test_an_agent_is_told_with_what_it_observed(path: Path) -> None:
    heard, recording = Heard(path, world=1), Recording(path)
    tick = recording.ticks(1, 0)[5]
    frame = recording.at(tick, 1, 0)
    row = recording.extra_at("observations", tick, 1)[0]
    found = heard.shown._details(frame, int(row["vehicle"]), True)
    names = [tuple(told[:2]) for told in found["observation"]]
    assert names == [tuple(name) for name in recording.head.features]
    numbers = [told[2] for told in found["observation"]]
    assert numbers == pytest.approx(row["values"].tolist(), abs=1e-4)
    assert [name for name, _ in found["terms"]] == list(recording.head.terms)
    others = frame.vehicles[frame.vehicles["agent"] < 0]
    assert "observation" not in heard.shown._details(frame, int(others["id"][0]), True)


def test_without_its_map_or_any_frame_it_is_refused(path: Path, tmp_path: Path) -> None:
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
