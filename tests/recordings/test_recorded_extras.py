"""Extra tables of a recording: observations, sensor samples and messages."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import ConfigError, RecordingError, RecordOptions, make_vec, parallel_env
from cavmarl.recordings import recording_writer
from cavmarl.recordings.extra_tables import take_rows
from cavmarl.recordings.recording import Recording
from cavmarl.v2x.kernels.v2x_records import KIND_CAM, NUM_KINDS
from tests.support.killed_recordings import killed_recording

pytestmark = pytest.mark.integration  # the manifest calls git

V2X = {"v2x.enabled": True, "v2x.roadside.signals": ["all"], "v2x.perception.rate_hz": 5.0}
RIG = {
    "rig": {
        "front": {"type": "semantic_camera", "width": 16, "height": 8, "rate_hz": 10.0},
        "imu": {"type": "imu", "rate_hz": 20.0},
    }
}


@pytest.mark.parametrize("zones", [1, 4])
def test_recorded_observations_equal_those_of_each_step(tmp_path: Path, zones: int) -> None:
    options = RecordOptions(tmp_path / "run", ("observations",))
    seen: list[list[Any]] = [[], []]
    with closing(
        make_vec("grid4x4", num_envs=2, zones=zones, agents=3, background=9, record=options)
    ) as vec:
        vec.reset(seed=3)
        for step in range(7):
            if step:
                vec.step(vec.suggest_actions())
            arrays = vec.worlds.arrays
            for world in range(2):
                here = np.flatnonzero(arrays.vehicle_ids[world] >= 0)
                seen[world].append((arrays.observations[world, here], arrays.terms[world, here]))
        terms = vec.config.terms.names
    recording = Recording.open(tmp_path / "run")
    assert recording.extras == ["observations"]
    assert list(recording.head.terms) == list(terms)
    for world in range(2):
        ticks = recording.ticks(world)
        assert len(ticks) == 7
        for tick, (values, paid) in zip(ticks, seen[world], strict=True):
            rows = recording.extra_at("observations", tick, world)
            assert rows["agent"].tolist() == [0, 1, 2]
            assert rows["values"].tobytes() == values.tobytes()
            assert rows["terms"].tobytes() == paid.tobytes()
        assert len(recording.extra("observations", world)) == 21
    assert len(recording.head.features) == seen[0][0][0].shape[1]
    assert recording.extra("observations", 0, episode=4).size == 0
    with pytest.raises(RecordingError, match="has no v2x; it has observations: record with"):
        recording.extra("v2x")


def test_rows_are_found_by_episode_if_episodes_have_equal_ticks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording_writer, "MOST_WAITING_BYTES", 1)  # one part per step
    options = RecordOptions(tmp_path / "run", ("observations",))
    seen = []
    with closing(make_vec("merge", num_envs=1, agents=2, background=0, record=options)) as vec:
        for seed in (1, 2):
            vec.reset(seed=seed)
            vec.step(vec.suggest_actions())
            seen.append(vec.worlds.arrays.observations[0].copy())
    recording = Recording.open(tmp_path / "run")
    assert recording.ticks(0, 0) == recording.ticks(0, 1)
    last = recording.ticks(0, 0)[-1]
    for episode in (0, 1):
        rows = recording.extra_at("observations", last, 0, episode)
        assert rows["values"].tobytes() == seen[episode][rows["agent"]].tobytes()
        assert len(rows) > 0
    assert not np.array_equal(seen[0], seen[1])


def test_recorded_samples_equal_those_of_the_rig(tmp_path: Path) -> None:
    options = RecordOptions(tmp_path / "run", ("samples",))
    taken = []
    with closing(
        parallel_env("grid4x4", agents=2, background=4, record=options, overrides=RIG)
    ) as env:
        env.reset(seed=1)
        for _ in range(3):
            env.step(env.suggest_actions())
            taken.append({name: env.frames("car_1")[name] for name in ("front", "imu")})
    recording = Recording.open(tmp_path / "run")
    assert sorted(recording.extras) == ["samples-front", "samples-imu"]
    for name in ("front", "imu"):
        for tick, frames in zip(recording.ticks()[1:], taken, strict=True):
            rows = recording.extra_at(f"samples-{name}", tick)
            rows = rows[rows["agent"] == 1]
            fresh = int(frames[name].fresh)
            assert len(rows) == fresh > 0
            assert rows["data"].dtype == frames[name].data.dtype
            assert rows["data"].tobytes() == frames[name].data[-fresh:].tobytes()
            assert rows["stamp_s"].tolist() == frames[name].stamp_s[-fresh:].tolist()


def test_all_sent_messages_are_recorded(tmp_path: Path) -> None:
    options = RecordOptions(tmp_path / "run", ("messages",))
    with closing(
        parallel_env("grid4x4", zones=4, agents=3, background=30, record=options, overrides=V2X)
    ) as env:
        env.reset(seed=0)
        for step in range(80):
            if step == 3:
                env.declare_event("car_1", "obstacle")
            env.step(env.suggest_actions())
        told = env.simulation.messages.statistics(0)
        transfers = env.simulation.coordinators[0].switched
    recording = Recording.open(tmp_path / "run")
    sent = recording.extra("v2x")
    packets = np.unique(sent[["tick", "sender", "kind"]])
    assert np.bincount(packets["kind"], minlength=NUM_KINDS).tolist() == list(told.sent)
    cams = sent[sent["kind"] == KIND_CAM]
    assert (cams["subject"] == cams["sender"]).all()
    frame = recording.at(40)
    cam = cams[cams["tick"] == 40][0]
    row = frame.vehicles[frame.vehicles["id"] == cam["sender"]][0]
    assert (row["x"], row["y"]) == (cam["x"], cam["y"]) == (cam["from_x"], cam["from_y"])
    said = recording.extra("handovers")
    assert transfers > 0
    assert sum(text.count("→") for text in said["text"]) == transfers
    assert set(said["kind"]) >= {"BEGIN", "COMMIT"}


@pytest.mark.parametrize(
    ("include", "more", "words"),
    [
        (("pictures",), {}, "must be of observations, samples, messages"),
        (("samples",), {}, "no vehicle carries sensors: set rig"),
        (("messages",), {}, "no messages are sent: set v2x.enabled"),
        (("messages",), {"workers": 2, "zones": 2}, "use backend='local'"),
        (
            ("observations",),
            {"overrides": {**RIG, "observation.mode": "sensors", "observation.kind": "dict"}},
            "include samples",
        ),
    ],
)
def test_extras_that_a_world_does_not_have_are_refused(
    tmp_path: Path, include: tuple[str, ...], more: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        parallel_env("grid4x4", record=RecordOptions(tmp_path / "run", include), **more)


PROGRAM = """
import sys, time
from cavmarl import RecordOptions, parallel_env
options = RecordOptions(sys.argv[1], ("observations", "messages"))
env = parallel_env("grid4x4", agents=2, background=6, record=options,
    overrides={"v2x.enabled": True})
env.reset(seed=5)
print("begun", flush=True)
while True:
    env.step(env.suggest_actions())
    time.sleep(0.01)  # parts are made by the clock: agents are to be there for long enough
"""


@pytest.mark.skipif(os.name != "posix", reason="kills with SIGKILL")
def test_a_killed_run_leaves_complete_tables(tmp_path: Path) -> None:
    path = tmp_path / "run"
    recording = killed_recording(path, PROGRAM, parts=2)
    ticks = recording.ticks()
    observed = recording.extra("observations")
    assert np.unique(observed["tick"]).tolist() == ticks
    assert recording.extra("v2x")["tick"].max() <= ticks[-1]
    for part in (path / "world-0" / "observations").glob("0*.parquet"):
        part.write_bytes(part.read_bytes()[:-30])
    with pytest.raises(RecordingError, match=r"observations/0+\.parquet: is damaged"):
        Recording.open(path).extra("observations")


def test_rows_at_the_first_tick_of_an_episode_belong_to_that_episode() -> None:
    rows = np.array([(0, 1), (3, 2), (4, 3)], dtype=[("tick", np.int64), ("id", np.int64)])
    (_, before), (_, own) = take_rows({"messages": rows}, 2, 3)
    assert (before.episode, before.rows["id"].tolist()) == (1, [3])
    assert (own.episode, own.rows["id"].tolist()) == (2, [1, 2])
