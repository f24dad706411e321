"""A replay shows the same sensor data of an agent as the live page, or reports missing data."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from cavmarl import RecordOptions, parallel_env
from cavmarl.recordings.recording import Recording
from cavmarl.viewer.recorded_sensors import RecordedSensors
from cavmarl.viewer.vehicle_details import vehicle_details

pytestmark = pytest.mark.integration  # a manifest reads the commit from git

RIG = {
    "roof": {"type": "lidar", "rate_hz": 10, "rays": 24, "z_m": 0.8, "range_m": 50},
    "front": {"type": "semantic_camera", "rate_hz": 5, "width": 16, "height": 8},
    "place": {"type": "gnss", "rate_hz": 1.0},
}
STEPS = 12


def recorded(path: Path, *include: str) -> list[tuple[int, int, Any]]:
    """Record some steps; return (tick, vehicle, details on the live page) of each step."""
    seen = []
    options = RecordOptions(path, include)
    with closing(
        parallel_env("merge", agents=2, background=6, record=options, overrides={"rig": RIG})
    ) as env:
        env.reset(seed=3)
        for _ in range(STEPS):
            env.step(env.suggest_actions())
            vehicle = int(env.worlds.arrays.vehicle_ids[0, 1])
            frame = env.world_frames()[0]
            told = vehicle_details(env, 0, frame, vehicle, sensors=True)
            seen.append((frame.tick, vehicle, told))
    return seen


def test_shapes_of_a_replay_equal_those_of_the_live_page(tmp_path: Path) -> None:
    seen = recorded(tmp_path / "run", "observations", "samples")
    sensors = RecordedSensors(Recording.open(tmp_path / "run"), 0, 0)
    names = set()
    for tick, vehicle, told in seen:
        found = sensors.of(tick, vehicle, sensors=True)
        assert found["shapes"] == told["shapes"]
        assert found["terms"] == told["terms"]
        assert found["note"] == ""
        names |= {shape["name"] for shape in found["shapes"]}
    assert {"roof", "front", "place", "neighbors"} <= names
    assert "shapes" not in sensors.of(*seen[0][:2], sensors=False)


@pytest.mark.parametrize(
    ("include", "note"),
    [
        ((), "has no observations and no samples of sensors; --record-also observations,samples"),
        (("observations",), "recording has no samples of sensors; --record-also samples records"),
    ],
)
def test_unrecorded_data_are_reported(tmp_path: Path, include: tuple[str, ...], note: str) -> None:
    tick, vehicle, told = recorded(tmp_path / "run", *include)[-1]
    found = RecordedSensors(Recording.open(tmp_path / "run"), 0, 0).of(tick, vehicle, sensors=True)
    assert note in found["note"]
    kept = [shape for shape in told["shapes"] if include and shape["name"] not in RIG]
    assert found["shapes"] == kept


def test_settings_of_another_version_are_reported(tmp_path: Path) -> None:
    tick, vehicle, _ = recorded(tmp_path / "run", "observations")[-1]
    recording = Recording.open(tmp_path / "run")
    recording.manifest["world"]["config"]["sensors"]["sonar"] = {"rays": 4}
    found = RecordedSensors(recording, 0, 0).of(tick, vehicle, sensors=True)
    assert found["shapes"] == []
    assert "that this version can read" in found["note"]
    assert found["observation"]
