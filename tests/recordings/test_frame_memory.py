"""Arrays of recorded frames are reused after they have been written."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import cavmarl
from cavmarl.engine.world_frame import SEEN, events_between
from cavmarl.recordings import recording_writer
from cavmarl.recordings.frame_memory import FrameMemory
from cavmarl.recordings.recording import Recording


def test_rows_are_reused_only_after_they_are_returned() -> None:
    memory = FrameMemory()
    first, second = memory.take(10), memory.take(10)
    assert not np.shares_memory(first, second)
    memory.give_back(np.empty(10, dtype=SEEN)[:5])  # rows of another array
    assert not np.shares_memory(memory.take(10), second)
    memory.give_back(first)
    assert np.shares_memory(memory.take(12), first)
    memory.give_back(second)
    assert len(memory.take(1000)) == 1000, "too few rows"


def test_rows_that_are_returned_twice_are_reused_once() -> None:
    memory = FrameMemory()
    rows = memory.take(10)
    memory.give_back(rows)
    memory.give_back(rows)
    assert not np.shares_memory(memory.take(10), memory.take(10))


def test_frames_recorded_in_reused_memory_equal_the_frames_of_the_world(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording_writer, "MOST_WAITING_BYTES", 20_000)
    env = cavmarl.parallel_env("merge", record=tmp_path / "run")
    env.reset(seed=4)
    shown = list(env.world_frames())
    while env.agents and len(shown) < 400:
        env.step(env.suggest_actions())
        shown += env.world_frames()
    env.close()
    recorded = list(Recording.open(tmp_path / "run").frames(world=0))
    assert len(list((tmp_path / "run/world-0/vehicles").iterdir())) > 3, "too few parts"
    assert [frame.vehicles.tobytes() for frame in recorded[: len(shown)]] == [
        frame.vehicles.tobytes() for frame in shown
    ]
    happened = [one for pair in pairwise(shown) for one in events_between(*pair)]
    assert happened, "no vehicle departed or left"
    told = [event for _, event in Recording.open(tmp_path / "run").events(world=0)]
    assert told[: len(happened)] == happened
