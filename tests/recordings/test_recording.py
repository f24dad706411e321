"""Recordings: the frames that are read equal the recorded frames, for each backend."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import CavEnv, RecordingError, make_vec, parallel_env
from cavmarl.core.records.codes import DRIVER_EXTERNAL, EVENT_RED_LIGHT
from cavmarl.engine.world_description import describe_world
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.engine.world_setup import load_world
from cavmarl.recordings.recording import Recording
from cavmarl.recordings.recording_writer import RecordingWriter
from tests.support.forks import said_in_fork
from tests.support.killed_recordings import killed_recording


def drive(env: CavEnv, steps: int) -> list[WorldFrame]:
    """Run a seeded episode; return the frame of its reset and of each step."""
    env.reset(seed=5)
    found = env.world_frames(ghosts=True)
    for _ in range(steps):
        env.step(env.suggest_actions())
        found += env.world_frames(ghosts=True)
    return found


def assert_same(one: WorldFrame, other: WorldFrame) -> None:
    assert one._fields == other._fields
    for name in one._fields:
        a, b = getattr(one, name), getattr(other, name)
        arrays = a if name == "ghosts" else (a,)
        others = b if name == "ghosts" else (b,)
        assert len(arrays) == len(others)
        for x, y in zip(arrays, others, strict=True):
            if isinstance(x, np.ndarray):
                assert x.dtype == y.dtype
                assert x.tobytes() == y.tobytes(), name
            else:
                assert x == y, name


def test_a_forked_process_cannot_write_to_a_recording(tmp_path: Path) -> None:
    path = tmp_path / "run"
    env = parallel_env("merge", agents=3, background=0, record=path)
    with closing(env):
        drive(env, 3)
        said = said_in_fork(lambda: env.step(env.suggest_actions()), env.close)
        assert f"the frames of {path} belong to process" in said
        assert not Recording.open(path).is_whole
        env.step(env.suggest_actions())
    recording = Recording.open(path)
    assert recording.is_whole
    assert len(list(recording.frames())) == 5


@pytest.mark.parametrize(("zones", "workers"), [(1, 0), (4, 0), (1, 1), (4, 2)])
def test_replayed_frames_equal_the_recorded_ones(tmp_path: Path, zones: int, workers: int) -> None:
    path = tmp_path / "run"
    env = parallel_env("grid4x4", zones=zones, workers=workers, record=path)
    with closing(env):
        shown = drive(env, 25)
    recording = Recording.open(path)
    replayed = list(recording.frames())
    assert len(replayed) == len(shown) == 26
    for one, other in zip(replayed, shown, strict=True):
        assert_same(one, other)
    assert recording.is_whole
    assert recording.worlds == [0]
    assert recording.episodes() == [0]
    assert recording.network.content_hash == env.network.content_hash
    assert recording.partition.count == zones
    assert recording.manifest["world"]["map_content_sha256"] == env.network.content_hash
    assert recording.manifest["software"]["packages"]["cavmarl"]


def test_each_world_has_its_own_folder_and_numbered_episodes(
    tmp_path: Path,
) -> None:
    with closing(make_vec("ring", num_envs=2, record=tmp_path / "run", max_cycles=5)) as vec:
        vec.reset(seed=1)
        for _ in range(12):
            vec.step(vec.suggest_actions())
    recording = Recording.open(tmp_path / "run")
    assert recording.worlds == [0, 1]
    for world in recording.worlds:
        assert recording.episodes(world) == [0, 1, 2]
        assert [frame.world for frame in recording.frames(world)] == [world] * 13
        ticks = recording.ticks(world, 1)
        assert ticks[0] == 0
        assert ticks == sorted(set(ticks))
        between = recording.at(ticks[2] + 1 if ticks[3] > ticks[2] + 1 else ticks[2], world, 1)
        assert between.tick == ticks[2]
    with pytest.raises(RecordingError, match="no frame at tick -1"):
        recording.at(-1)
    with pytest.raises(RecordingError, match="no world 7; the worlds are 0, 1"):
        next(recording.frames(7))


def test_an_episode_without_a_step_is_recorded(tmp_path: Path) -> None:
    with closing(make_vec("ring", record=tmp_path / "run", agents=1, background=0)) as vec:
        for seed in (1, 2):
            vec.reset(seed=seed)
        vec.step(vec.suggest_actions())
    recording = Recording.open(tmp_path / "run")
    assert recording.episodes(0) == [0, 1]
    assert [len(recording.ticks(0, episode)) for episode in (0, 1)] == [1, 2]


def test_a_trip_that_ends_in_the_step_before_an_autoreset_has_an_event(tmp_path: Path) -> None:
    """The last step before an autoreset has no frame, but trips that end in it have events."""
    arguments: dict[str, Any] = {"agents": 2, "background": 0, "max_cycles": 40}
    with closing(make_vec("ring", record=tmp_path / "run", **arguments)) as vec:
        vec.reset(seed=1)
        actions = np.ones(vec.action_space.shape, dtype=np.float32)
        for _ in range(40):
            vec.step(actions)
    kinds = {found.event.kind for found in Recording.open(tmp_path / "run").events()}
    assert kinds & {"off_road", "collision", "wrong_way"}


def test_events_of_the_last_frame_of_an_episode_are_recorded_once(tmp_path: Path) -> None:
    """The frame after the last frame of an episode is the first frame of the next episode."""
    world = load_world("ring", agents=1, background=1)
    with closing(parallel_env("ring", agents=1, background=1)) as env:
        first, second, third = drive(env, 2)
    third.vehicles["events"][-1] = EVENT_RED_LIGHT
    described = world.config, world.network, world.demand, world.partition
    writer = RecordingWriter(
        tmp_path / "run",
        environment="ring-v1",
        network=world.network,
        partition=world.partition,
        halo_m=0.0,
        sim_dt_s=0.1,
        step_s=0.1 * (second.tick - first.tick),
        manifest={"world": describe_world(*described)},
    )
    writer.add([first])
    writer.add([second])
    writer.add([third])
    writer.add([first])
    writer.close()
    found = [one.event for one in Recording.open(tmp_path / "run").events()]
    assert [one.tick for one in found if one.kind == "red_light"] == [third.tick]


def test_copies_of_an_environment_do_not_record(tmp_path: Path) -> None:
    from copy import deepcopy

    with closing(parallel_env("ring", record=tmp_path / "run")) as env:
        env.reset(seed=1)
        copied = deepcopy(env)
        copied.step(copied.suggest_actions())
    assert len(list(Recording.open(tmp_path / "run").frames())) == 1


PROGRAM = """
import sys, time
from cavmarl import parallel_env
env = parallel_env("ring", record=sys.argv[1])
env.reset(seed=5)
print("begun", flush=True)
while True:
    env.step(env.suggest_actions())
    time.sleep(0.01)
    if not env.agents:
        env.reset()
"""


@pytest.mark.skipif(os.name != "posix", reason="kills with SIGKILL")
def test_a_killed_run_leaves_all_committed_frames(tmp_path: Path) -> None:
    replayed = list(killed_recording(tmp_path / "run", PROGRAM, parts=3).frames())
    assert len(replayed) > 3
    with closing(parallel_env("ring")) as env:
        for one, other in zip(replayed, drive(env, 20), strict=False):
            assert_same(one, other)


def test_a_process_that_ends_without_close_leaves_a_complete_recording(tmp_path: Path) -> None:
    program = PROGRAM.replace("while True", "for _ in range(9)")
    subprocess.run([sys.executable, "-c", program, str(tmp_path / "run")], check=True)
    recording = Recording.open(tmp_path / "run")
    assert recording.is_whole
    assert len(list(recording.frames())) == 10


def test_a_recording_has_external_vehicles(tmp_path: Path) -> None:
    path = tmp_path / "run"
    overrides = {"population.external": 2}
    env = parallel_env("ring", agents=1, background=0, record=path, overrides=overrides)
    with closing(env):
        env.reset(seed=5)
        x, y, _, heading, *_ = env.network.pose_on(0, 5.0)
        env.external.spawn(float(x), float(y), float(heading))
        env.step(env.suggest_actions())
        driven = env.world_frames()[0]
    frames = list(Recording.open(path).frames())
    assert DRIVER_EXTERNAL in driven.vehicles["driver"]
    assert frames[-1].vehicles.tobytes() == driven.vehicles.tobytes()
