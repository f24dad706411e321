"""Worlds with the sensors of their drivers, with and without the option `--sensors-of`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from cavmarl.config.registry import agent_entries
from cavmarl.evaluate.zoo import verify_entry
from tests.cli.test_main import QUICK, refusal, run

pytest.importorskip("torch")

pytestmark = pytest.mark.integration  # a manifest reads the commit from git


def test_a_world_gets_the_sensors_of_a_trained_driver(
    capsys: pytest.CaptureFixture[str], shared_maps: Path, tmp_path: Path
) -> None:
    city = str(shared_maps / "net" / "Town10HD.net.xml")
    out = tmp_path / "out"
    drivers = ("-p", "cities_residual", "-p", "idm")
    assert run("evaluate", city, *drivers, "-n", "1", *QUICK, "--out", str(out)) == 0
    notes = [line for line in capsys.readouterr().err.splitlines() if "sensors" in line]
    assert notes == [
        f"cavmarl: {city} gets the sensors and actions of cities_residual (10 keys, as with "
        "--sensors-of cities_residual)"
    ]
    job = json.loads((out / "manifest.json").read_text())["job"]
    assert job["overrides"]["sensors.history.steps"] == 3


def test_drivers_that_need_different_sensors_are_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    drivers = ("-p", "cities_residual", "-p", "shielded:merge_ippo", "-p", "idm")
    said = refusal(capsys, "evaluate", "merge", *drivers, *QUICK, "--out", str(tmp_path / "out"))
    assert "The drivers cities_residual, merge_ippo need different sensors or actions" in said
    assert "sensors.history.steps is 3 for cities_residual, 0 for merge_ippo" in said


def test_settings_that_contradict_the_driver_are_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ("evaluate", "merge", "--set", "sensors.route.points=8", "--out", str(tmp_path / "out"))
    for driver in (("-p", "cities_residual"), ("--sensors-of", "cities_residual")):
        said = refusal(capsys, *words, *driver)
        assert "sensors.route.points is 8 in the overrides, 0 for cities_residual" in said
    assert "'idm' is a script" in refusal(capsys, "evaluate", "merge", "--sensors-of", "idm")
    assert "did you mean idm" in refusal(capsys, "evaluate", "merge", "--sensors-of", "idn")


def test_the_result_of_a_driver_with_its_own_sensors_is_verified(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    entry = shutil.copytree(agent_entries()["cities_residual"], tmp_path / "mine")
    shutil.rmtree(entry / "result")
    for option in (("--sensors-of", str(entry)), ()):
        words = ("evaluate", "merge", "-p", str(entry), "-n", "1", *QUICK, *option)
        assert run(*words, "--out", str(entry / "result")) == 0
        assert ("gets the sensors" in capsys.readouterr().err) == (not option)
        again = verify_entry(entry)
        assert not again.differing
        assert capsys.readouterr().err == ""
        shutil.rmtree(entry / "result")


def test_a_recording_with_the_sensors_of_a_driver_is_replayed(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    pytest.importorskip("pyarrow")
    record, lines = tmp_path / "record", tmp_path / "lines.csv"
    words = ("evaluate", "merge", "-p", "cities_residual", "-n", "1", *QUICK)
    more = ("--record", str(record), "--record-also", "observations")
    assert run(*words, *more, "--out", str(tmp_path / "out")) == 0
    assert run("replay", str(record), "--csv", str(lines)) == 0
    assert len(lines.read_text().splitlines()) > 1


def test_a_view_of_a_world_on_workers_uses_the_sensors_of_the_driver(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    pytest.importorskip("imageio_ffmpeg")
    words = ("view", "merge", "-p", "cities_residual", "--seconds", "0.3", *QUICK[4:])
    over = ("--zones", "2", "--workers", "2", "--sensors-of", "cities_residual")
    found = []
    for option in ((), over):
        path = tmp_path / "view.json"
        video = ("--video", str(tmp_path / "view.mp4"))
        assert run(*words, *option, *video, "--json", str(path)) == 0
        assert ("gets the sensors" in capsys.readouterr().err) == (not option)
        found.append(json.loads(path.read_text())["traffic"])
    assert found[0] == found[1]
