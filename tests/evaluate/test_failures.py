"""Failed trips: their causes, ranking and clips, and their page in a browser."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import RecordingError, RecordOptions, make_vec
from cavmarl.config.env import EnvConfig
from cavmarl.config.io import validate
from cavmarl.config.registry import find_entry
from cavmarl.evaluate import evaluate, failure_clips
from cavmarl.evaluate.evaluation import load_tables
from cavmarl.evaluate.failure_clips import CAUSES, REACH_M, Failure, FailureClips, cause_of, worst
from cavmarl.evaluate.failure_page import write_failures
from cavmarl.evaluate.tables import TRIP
from cavmarl.recordings.recording import Recording
from cavmarl.roads.cache import load_network
from cavmarl.sensors.sensed_shapes import observed_shapes
from tests.support.chromium import chromium

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    room = tmp_path_factory.mktemp("failures")
    record = room / "recordings"
    evaluate(
        "merge",
        ["random_actions", "idm"],
        episodes=2,
        out=room / "out",
        record=RecordOptions(record, ("observations",)),
        failures=6,
    )
    return room


def data_of(page: Path) -> Any:
    text = page.read_text(encoding="utf-8")
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def test_the_page_has_the_worst_trips_with_clips_of_ten_seconds(folder: Path) -> None:
    data = data_of(folder / "out" / "failures.html")
    tables = load_tables(folder / "out")
    assert len(data["failures"]) == 6
    for failure in data["failures"]:
        trips, _ = tables[failure["policy"]]
        failed = trips[trips["counted"] & ~trips["success"]]
        (trip,) = failed[
            (failed["episode"] == failure["episode"])
            & (failed["agent"] == failure["agent"])
            & (np.abs(failed["began_s"] - failure["began_s"]) < 0.01)
        ]
        assert failure["cause"] == "slow" or trip[failure["cause"]]
        frames = failure["clip"]["frames"]
        assert 1 < len(frames) <= round(10.0 / failure["step_s"]) + 1
        ticks = [tick for tick, _ in frames]
        assert ticks == sorted(set(ticks))
        (mine,) = [row for row in frames[-1][1] if row[0] == failure["vehicle"]]
        assert mine[1:3] == failure["center_m"]
        for _, rows in frames:
            for vehicle, x, y, *_ in rows:
                assert str(vehicle) in failure["clip"]["vehicles"]
                assert abs(x - failure["center_m"][0]) < REACH_M + 0.01
                assert abs(y - failure["center_m"][1]) < REACH_M + 0.01


def test_a_clip_equals_the_recording(folder: Path) -> None:
    failure = data_of(folder / "out" / "failures.html")["failures"][0]
    path = folder / "recordings" / failure["policy"] / "run-0"
    recording = Recording.open(path)
    assert recording.manifest["policy"] == failure["policy"]
    for tick, rows in failure["clip"]["frames"]:
        frame = recording.at(tick, failure["episode"])
        assert frame.tick == tick
        by_id = {int(row["id"]): row for row in frame.vehicles}
        for vehicle, x, y, *_ in rows:
            assert (x, y) == (round(by_id[vehicle]["x"], 2), round(by_id[vehicle]["y"], 2))


def test_a_clip_has_the_observations_of_the_vehicle(folder: Path) -> None:
    failure = data_of(folder / "out" / "failures.html")["failures"][0]
    recording = Recording.open(folder / "recordings" / failure["policy"] / "run-0")
    config = validate(EnvConfig, recording.manifest["world"]["config"], "manifest")
    clip, seen = failure["clip"], 0
    assert clip["sensors_note"] == ""
    assert len(clip["sensors"]) == len(clip["frames"])
    for (tick, _), shapes in zip(clip["frames"], clip["sensors"], strict=True):
        rows = recording.extra_at("observations", tick, failure["episode"])
        for values in rows["values"][rows["vehicle"] == failure["vehicle"]]:
            drawn = [one for one in observed_shapes(config, values) if one["kind"] == "links"]
            assert [one["name"] for one in shapes] == [one["name"] for one in drawn]
            for shape, one in zip(shapes, drawn, strict=True):
                assert shape["points"] == [round(value, 1) for value in one["points"]]
                seen += len(shape["points"])
    assert seen > 0


def test_observations_that_need_too_much_memory_are_not_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(failure_clips, "MOST_KEPT_BYTES", 1000)
    with closing(make_vec("merge", agents=2, background=4)) as vec:
        vec.reset(seed=0)
        clips = FailureClips(1, vec.config, {}, vec.worlds.arrays.observations)
        clips.add(vec.world_frames([0], ghosts=False))
        trip = np.zeros(1, dtype=TRIP)
        trip["counted"] = trip["collision"] = True
        clips.take(trip, 0)
    clip = clips.failures[0].clip
    assert clip["sensors"] == []
    assert "were not kept" in clip["sensors_note"]


def test_the_page_loads_nothing_from_other_hosts(folder: Path) -> None:
    text = (folder / "out" / "failures.html").read_text(encoding="utf-8")
    assert "http" not in text.replace("http-equiv", "")
    assert "default-src 'none'" in text
    assert "unsafe" not in text


@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium")
def test_a_browser_shows_the_page(folder: Path) -> None:
    page = folder / "out" / "failures.html"
    assert CHROMIUM is not None
    words = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=2000"]
    done = subprocess.run(
        [*words, "--dump-dom", page.as_uri()], capture_output=True, text=True, timeout=120
    )
    assert 'data-ready="yes"' in done.stdout
    body = done.stdout[done.stdout.index('<tbody id="rows">') : done.stdout.index("</tbody>")]
    assert body.count("<tr ") == len(data_of(page)["failures"])
    shown = re.search(r'<canvas[^>]*data-tick="(\d+)" data-shown="(\d+)"', done.stdout)
    assert shown is not None
    assert int(shown[2]) > 0


def test_the_replay_shows_the_observations_of_the_vehicle(folder: Path) -> None:
    with chromium() as browser:
        page = browser.new_page()
        problems: list[str] = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto((folder / "out" / "failures.html").as_uri())
        page.evaluate(
            "(() => { const seek = document.querySelector('#seek'); seek.value = seek.max;"
            "seek.dispatchEvent(new Event('input')); })()"
        )
        picture = "document.querySelector('#view').toDataURL()"
        assert "neighbors" in page.get_attribute("#view", "data-sensed").split()
        with_sensors = page.evaluate(picture)
        page.uncheck("#sensors")
        assert page.evaluate(picture) != with_sensors
        assert not problems


def test_names_with_markup_cannot_end_the_script_of_the_page(tmp_path: Path) -> None:
    name = "</script><script>alert(1)</script>"
    trip = {"policy": name, "center_m": (0.0, 0.0), "agent": 0, "run": 0, "episode": 0}
    failure = Failure(
        "collision",
        1.0,
        trip,
        {"vehicles": {}, "frames": [[0, []]], "sensors": [], "sensors_note": ""},
    )
    network = load_network(find_entry("ring") / "map" / "map.net.xml")
    write_failures(tmp_path / "page.html", [failure], 5, 1, network, name)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "alert(1)</script>" not in text
    assert data_of(tmp_path / "page.html")["failures"][0]["policy"] == name


def test_the_worst_trips_of_each_cause_are_chosen_in_turn() -> None:
    failures = [
        Failure(cause, float(k), {}, {}) for cause in ("collision", "slow") for k in range(10)
    ]
    failures.append(Failure("red_light", 3.0, {}, {}))
    chosen = worst(failures, 7)
    assert [(one.cause, one.severity) for one in chosen] == [
        ("collision", 9.0),
        ("collision", 8.0),
        ("collision", 7.0),
        ("red_light", 3.0),
        ("slow", 9.0),
        ("slow", 8.0),
        ("slow", 7.0),
    ]
    assert len(worst(failures, 100)) == 21


@pytest.mark.parametrize(
    ("marks", "cause"),
    [
        (["collision", "red_light"], "collision"),
        (["off_road"], "off_road"),
        (["red_light", "arrived"], "red_light"),
        (["wrong_way"], "wrong_way"),
        (["unfinished", "blocked"], "blocked"),
        (["unfinished", "stood"], "stood"),
        (["unfinished", "out_of_time"], "out_of_time"),
        (["arrived"], "slow"),
    ],
)
def test_a_failed_trip_has_the_most_important_of_its_causes(marks: list[str], cause: str) -> None:
    trip = np.zeros(1, dtype=TRIP)
    for mark in marks:
        trip[mark] = True
    assert cause_of(trip[0]) == cause
    assert cause in CAUSES


def test_an_existing_recording_folder_is_refused_before_the_first_run(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").write_text("kept")
    with pytest.raises(RecordingError, match="name a new folder"):
        evaluate("ring", "idm", episodes=1, out=tmp_path / "out", record=tmp_path / "there")
    assert not (tmp_path / "out").exists()
