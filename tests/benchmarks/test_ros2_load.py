"""Large and frequent messages all reach a node of real `rclpy`."""

from __future__ import annotations

import os

import pytest

from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError

pytest.importorskip("rosbags", reason="needs the extra 'ros2'")
pytest.importorskip("cyclonedds", reason="needs the extra 'ros2'")

from benchmarks.ros2_clock import PYTHON
from benchmarks.ros2_load import CLOUD, IMU, PICTURE, send

SPEC = WorldSpec.of("grid4x4", agents=1, background=4, seed=0)
DOMAIN = 10 + os.getpid() % 80


def test_a_run_without_the_path_of_a_python_with_rclpy_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv(PYTHON, raising=False)
    with pytest.raises(ConfigError, match=f"{PYTHON}: name a Python with rclpy; `make ros2`"):
        send(SPEC, steps=5, pace=1.0, domain=DOMAIN)


@pytest.mark.integration
@pytest.mark.skipif(not os.environ.get(PYTHON), reason=f"rclpy is not installed: set {PYTHON}")
def test_no_cloud_picture_or_inertial_sample_is_lost() -> None:
    rows, _ = send(SPEC, steps=60, pace=1.0, domain=DOMAIN)
    found = {row["topic"]: row for row in rows}
    assert {topic: row["lost"] for topic, row in found.items()} == {CLOUD: 0, PICTURE: 0, IMU: 0}
    assert found[CLOUD]["bytes"] == 64_000 * 16
    assert found[PICTURE]["bytes"] == 640 * 360 * 3
    assert found[IMU]["sent"] >= 300
