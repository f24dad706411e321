"""Clock drift of a node of ROS 2 with real `rclpy`, as in Table II of the co-simulation paper.

An own tick is a tick that the bridge requests although another caller is the time master.
"""

from __future__ import annotations

import os

import pytest

from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError
from cavmarl.cosim.time_master import OwnTicks

pytest.importorskip("rosbags", reason="needs the extra 'ros2'")
pytest.importorskip("cyclonedds", reason="needs the extra 'ros2'")

from benchmarks.ros2_clock import PYTHON, measure_ros_drift

SPEC = WorldSpec.of("grid4x4", agents=1, background=0, seed=0)
DOMAIN = 10 + os.getpid() % 80


def test_a_run_without_the_path_of_a_python_with_rclpy_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv(PYTHON, raising=False)
    with pytest.raises(ConfigError, match=f"{PYTHON}: name a Python with rclpy; `make ros2`"):
        measure_ros_drift(SPEC, steps=5, rogue=0.0, own_ticks="refuse", domain=DOMAIN)


@pytest.mark.integration
@pytest.mark.skipif(not os.environ.get(PYTHON), reason=f"rclpy is not installed: set {PYTHON}")
@pytest.mark.parametrize("own_ticks", ["obey", "refuse"])
def test_own_ticks_of_a_bridge_are_noticed_and_can_be_refused(own_ticks: OwnTicks) -> None:
    found, report = measure_ros_drift(
        SPEC, steps=100, rogue=0.92, own_ticks=own_ticks, domain=DOMAIN
    )
    (row,) = found.rows
    assert (found.own_ticks, found.counted) == (92, 92)
    assert report["controls"]["late"] == 0
    assert row.master_s == 5.0
    if own_ticks == "obey":
        assert row.delta_s == pytest.approx(4.6)
        assert row.ratio == 1.92
    else:
        assert (row.delta_s, row.ratio) == (0.0, 1.0)
    assert found.holds
