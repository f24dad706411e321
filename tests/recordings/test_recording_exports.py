"""Exports of a recording: FCD, emissions, CSV, MCAP, pictures and the command."""

from __future__ import annotations

import csv
import json
import math
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from defusedxml import ElementTree
from mcap.reader import make_reader

from cavmarl import ConfigError, load_policy, parallel_env
from cavmarl.cli import main
from cavmarl.driving.vehicle_emissions import emissions_of
from cavmarl.engine.world_frame import SEEN, WorldFrame
from cavmarl.recordings.recording import Recording
from cavmarl.recordings.recording_exports import (
    write_csv,
    write_emissions,
    write_fcd,
    write_mcap,
)
from cavmarl.recordings.replay_pictures import ReplayPictures

pytestmark = pytest.mark.integration  # the manifest calls git, videos need ffmpeg

STEPS = 12


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings") / "run"
    with closing(parallel_env("grid4x4", zones=4, record=folder)) as env:
        policy = load_policy("idm", env)
        observations, _ = env.reset(seed=2)
        for _ in range(STEPS):
            observations, *_ = env.step(policy.act(observations))
    return folder


@pytest.fixture
def frames(path: Path) -> list[WorldFrame]:
    return list(Recording.open(path).frames())


def test_fcd_has_each_vehicle_in_sumos_format(
    path: Path, frames: list[WorldFrame], tmp_path: Path
) -> None:
    recording = Recording.open(path)
    assert write_fcd(recording, tmp_path / "fcd.xml", 0, 0) == STEPS + 1
    root = ElementTree.parse(tmp_path / "fcd.xml").getroot()
    assert root.tag == "fcd-export"
    for step, frame in zip(root, frames, strict=True):
        assert float(step.get("time")) == pytest.approx(frame.time_s)
        for line, row in zip(step, frame.vehicles, strict=True):
            assert int(line.get("id")) == row["id"]
            angle = math.radians(90.0 - float(line.get("angle")))
            back = 0.5 * float(row["length"])
            assert float(line.get("x")) - back * math.cos(angle) == pytest.approx(
                row["x"], abs=0.01
            )
            assert float(line.get("y")) - back * math.sin(angle) == pytest.approx(
                row["y"], abs=0.01
            )
            assert line.get("lane") == recording.network.lane_ids[row["lane"]]
            assert line.get("type") == "passenger"


def test_emissions_have_energy_co2_and_fuel_of_each_vehicle(
    path: Path, frames: list[WorldFrame], tmp_path: Path
) -> None:
    recording = Recording.open(path)
    assert write_emissions(recording, tmp_path / "emissions.xml", 0, 0) == STEPS + 1
    root = ElementTree.parse(tmp_path / "emissions.xml").getroot()
    assert root.tag == "emission-export"
    total_mg = 0.0
    for step, frame in zip(root, frames, strict=True):
        used = emissions_of(frame.vehicles, frame.vehicles["vclass"], recording.head.step_s)
        for line, row, (energy_wh, co2_g) in zip(step, frame.vehicles, used, strict=True):
            assert int(line.get("id")) == row["id"]
            assert float(line.get("electricity")) == pytest.approx(energy_wh, abs=1e-5)
            assert float(line.get("CO2")) == pytest.approx(1e3 * co2_g, abs=0.01)
            assert float(line.get("fuel")) == pytest.approx(324.18 * co2_g, abs=0.01)
            ahead = 0.5 * row["length"] * np.array([np.cos(row["heading"]), np.sin(row["heading"])])
            front = np.array([row["x"], row["y"]]) + ahead
            assert [float(line.get("x")), float(line.get("y"))] == pytest.approx(front, abs=0.001)
            total_mg += float(line.get("CO2"))
    assert total_mg > 0.0


def test_emissions_are_totals_since_the_previous_frame(
    path: Path, frames: list[WorldFrame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames can be several steps apart, as in recordings of the server for CARLA's clients."""
    late = [frames[0], *(frame._replace(time_s=frame.time_s + 0.7) for frame in frames[1:])]
    monkeypatch.setattr(Recording, "frames", lambda *_: iter(late))
    write_emissions(Recording.open(path), tmp_path / "emissions.xml", 0, 0)
    steps = ElementTree.parse(tmp_path / "emissions.xml").getroot()
    for k, dt_s in ((1, late[1].time_s), (2, late[2].time_s - late[1].time_s)):
        rows = late[k].vehicles
        co2_g = emissions_of(rows, rows["vclass"], dt_s)[:, 1].sum()
        total_mg = sum(float(line.get("CO2")) for line in steps[k])
        assert total_mg == pytest.approx(1e3 * co2_g, abs=0.01 * len(rows))
        assert co2_g > 0.0


def test_csv_has_all_numbers_with_full_precision(
    path: Path, frames: list[WorldFrame], tmp_path: Path
) -> None:
    write_csv(Recording.open(path), tmp_path / "all.csv", 0, 0)
    with (tmp_path / "all.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    rows = np.concatenate([frame.vehicles for frame in frames])
    for name in SEEN.names or ():
        told = np.array([float(line[name]) for line in lines])
        np.testing.assert_array_equal(told, rows[name].astype(np.float64))


def test_mcap_has_scenes_and_events(path: Path, frames: list[WorldFrame], tmp_path: Path) -> None:
    recording = Recording.open(path)
    write_mcap(recording, tmp_path / "run.mcap", 0, 0)
    scenes, events = [], []
    with (tmp_path / "run.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            told = json.loads(message.data)
            if channel.topic == "/events":
                events.append(told)
                continue
            assert schema.name == "foxglove.SceneUpdate"
            scenes.append((message.log_time, told))
    assert len(scenes) == len(frames)
    for (log_time, scene), frame in zip(scenes, frames, strict=True):
        assert log_time == round(frame.time_s * 1e9)
        assert [int(entity["id"]) for entity in scene["entities"]] == frame.vehicles["id"].tolist()
    assert sorted(map(str, events)) == sorted(str(e.event._asdict()) for e in recording.events())


def test_pictures_of_a_recording_equal_those_of_the_world(tmp_path: Path) -> None:
    made = parallel_env("grid4x4", zones=4, render_mode="rgb_array", record=tmp_path / "run")
    with closing(made) as env:
        env.reset(seed=2)
        env.ghosts_of = 1
        shown = [env.render()]
        for _ in range(4):
            env.step(env.suggest_actions())
            shown.append(env.render())
    recording = Recording.open(tmp_path / "run")
    pictures = ReplayPictures(recording, ghosts_of=1)
    for frame, picture in zip(recording.frames(), shown, strict=True):
        assert picture is not None
        drawn = pictures.picture(frame)
        assert drawn.shape == picture.shape
        differing = (drawn[:, :, :] != picture).any(axis=2)
        assert differing[60:].mean() < 0.002  # the titles differ
    pictures.close()
    with pytest.raises(ConfigError, match="ghosts_of = 9"):
        ReplayPictures(recording, ghosts_of=9)


def test_the_command_writes_all_exports_and_a_video(path: Path, tmp_path: Path) -> None:
    words = [
        "replay",
        str(path),
        "--fcd",
        str(tmp_path / "a.xml"),
        "--csv",
        str(tmp_path / "a.csv"),
    ]
    words += ["--mcap", str(tmp_path / "a.mcap"), "--video", str(tmp_path / "a.mp4")]
    with pytest.raises(SystemExit) as ended:
        main([*words, "--json", str(tmp_path / "a.json")])
    assert not ended.value.code
    told = json.loads((tmp_path / "a.json").read_text())
    assert (told["frames"], told["whole"], told["worlds"]) == (STEPS + 1, True, [0])
    for name in ("a.xml", "a.csv", "a.mcap", "a.mp4"):
        assert (tmp_path / name).stat().st_size > 500


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["nothing"], "no recording"),
        (["PATH", "--world", "4"], "no world 4"),
        (["PATH", "--episode", "4", "--csv", "x.csv"], "no episode 4"),
    ],
)
def test_the_command_refuses_missing_worlds_and_files(
    path: Path, words: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [str(path) if word == "PATH" else word for word in words]
    given = [str(tmp_path / word) if word == "x.csv" else word for word in given]
    with pytest.raises(SystemExit) as ended:
        main(["replay", *given])
    assert ended.value.code == 2
    assert told in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "x.csv").exists()


def test_the_view_command_records(tmp_path: Path) -> None:
    words = ["view", "ring", "--seconds", "1", "--video", str(tmp_path / "a.mp4")]
    with pytest.raises(SystemExit) as ended:
        main([*words, "--record", str(tmp_path / "run")])
    assert not ended.value.code
    assert len(list(Recording.open(tmp_path / "run").frames())) > 2
