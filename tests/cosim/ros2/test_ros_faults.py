"""The world continues if nodes use other types or domains, die, or flood a topic."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import pytest

from cavmarl.cosim.ros2 import ros_bridge
from cavmarl.cosim.ros2.dds_node import DdsNode
from cavmarl.cosim.ros2.ros_bridge import RosOptions
from cavmarl.cosim.ros2.ros_types import RosTypes
from tests.cosim.ros2.conftest import DRIVE, TWIST, Driver, Run, cruise

ROOT = Path(__file__).resolve().parents[3]

# Answers ten clock messages, prints "heard", and waits to be killed.
MORTAL = """
import sys, time
from cavmarl.cosim.ros2.ros_types import RosTypes
from tests.cosim.ros2.conftest import Driver, cruise
heard = []
def answer(stamp):
    heard.append(stamp)
    return cruise(stamp)
with Driver(RosTypes(), int(sys.argv[1]), answer=answer):
    while len(heard) < 11:  # ten answers have been sent
        time.sleep(0.001)
    print("heard", flush=True)
    time.sleep(60.0)
"""


def test_a_topic_with_another_type_is_logged_once_and_the_world_continues(
    types: RosTypes, domain: int, run_bridge: Run, caplog: pytest.LogCaptureFixture
) -> None:
    sent = {DRIVE: "geometry_msgs/msg/Twist"}
    received = {"/car_0/imu": "sensor_msgs/msg/Image"}
    with closing(DdsNode(types, "teleop", domain, sent, received)):
        time.sleep(0.5)
        report, _ = run_bridge(RosOptions(domain=domain, ready_s=1.0, deadline_s=0.1), 20)
    assert report["type_mismatches"] == [
        ["/car_0/cmd_vel", "geometry_msgs/msg/Twist"],
        ["/car_0/imu", "sensor_msgs/msg/Image"],
    ]
    told = [one for one in caplog.messages if "uses this topic with the type" in one]
    assert len(told) == 2
    assert (
        "/car_0/cmd_vel: a node uses this topic with the type geometry_msgs/msg/Twist, but the "
        "bridge uses geometry_msgs/msg/TwistStamped" in caplog.text
    )
    assert report["controls"]["car_0"]["received"] == 0
    assert report["steps"] == 21


def test_equal_types_are_not_a_mismatch(types: RosTypes, domain: int, run_bridge: Run) -> None:
    with Driver(types, domain, {"/car_0/imu": "sensor_msgs/msg/Imu"}):
        report, _ = run_bridge(RosOptions(domain=domain), 5)
    assert report["type_mismatches"] == []


def test_a_node_of_another_domain_is_not_heard(
    types: RosTypes, domain: int, run_bridge: Run, caplog: pytest.LogCaptureFixture
) -> None:
    with Driver(types, domain + 1):
        report, _ = run_bridge(RosOptions(domain=domain, ready_s=1.0, deadline_s=0.1), 5)
    assert report["controls"]["car_0"]["received"] == 0
    assert f"no node publishes commands for car_0 on domain {domain}" in caplog.text


def test_commands_of_a_dead_node_count_as_late(domain: int, run_bridge: Run) -> None:
    command = [sys.executable, "-c", MORTAL, str(domain)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as node:

        def kill() -> None:
            assert node.stdout is not None
            node.stdout.readline()
            node.kill()

        killer = threading.Thread(target=kill)
        killer.start()
        report, _ = run_bridge(RosOptions(domain=domain, ready_s=20.0, deadline_s=0.3), 30)
        killer.join(20.0)
    counts = report["controls"]["car_0"]
    assert report["steps"] == 31
    assert counts["used"] >= 10
    assert counts["late"] > 10
    # The bridge repeats the last command.
    assert counts["held"] == counts["late"]


def test_a_node_that_floods_a_topic_does_not_delay_steps(
    types: RosTypes, domain: int, run_bridge: Run
) -> None:
    sent = {DRIVE: TWIST}
    past = types.encode(TWIST, cruise(0))
    broken = cruise(10**15)
    broken["twist"]["linear"]["x"] = math.nan
    wrong = types.encode(TWIST, broken)
    over = threading.Event()
    with closing(DdsNode(types, "flood", domain, sent, {})) as flood, Driver(types, domain):

        def pour() -> None:
            while not over.is_set():
                for _ in range(50):
                    flood.publish(DRIVE, past)
                    flood.publish(DRIVE, wrong)

        thread = threading.Thread(target=pour)
        thread.start()
        try:
            # If the flood pushes commands out of the buffer, the bridge repeats the last command.
            options = RosOptions(domain=domain, deadline_s=0.2)
            began_s = time.monotonic()
            report, _ = run_bridge(options, 60)
            passed_s = time.monotonic() - began_s
        finally:
            over.set()
            thread.join(10.0)
    counts = report["controls"]["car_0"]
    assert report["steps"] == 61
    assert counts["old"] > 100
    assert counts["invalid"] > 100
    assert counts["used"] + counts["held"] == 61
    assert counts["used"] > 5
    assert passed_s < 40.0


@pytest.mark.parametrize(("limit", "is_told"), [("212992", True), ("4194304", False), ("", False)])
def test_a_warning_names_the_setting_if_socket_buffers_are_small(
    limit: str,
    is_told: bool,
    domain: int,
    run_bridge: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    file = tmp_path / "rmem_max"
    file.write_text(limit)
    monkeypatch.setattr(ros_bridge, "BUFFER_LIMIT", file)
    run_bridge(RosOptions(domain=domain, ready_s=0.1, deadline_s=0.0), 2)
    assert ("sysctl -w net.core.rmem_max=4194304" in caplog.text) == is_told
    assert ("net.core.rmem_max = 212992" in caplog.text) == is_told
