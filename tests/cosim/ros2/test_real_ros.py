"""Real ROS 2: a node with `rclpy`, in each Python that `CAVMARL_RCLPY_PYTHON` names.

Colons separate several Pythons, for example one with Jazzy and one with Kilted. `make ros2`
creates these Pythons.
"""

from __future__ import annotations

import json
import os
import subprocess
import textwrap
from typing import Any

import pytest

from benchmarks.ros2_clock import ros_environment
from cavmarl.cosim.ros2.ros_bridge import RosOptions
from tests.cosim.ros2.conftest import Run

PYTHONS = list(filter(None, os.environ.get("CAVMARL_RCLPY_PYTHON", "").split(":")))

NODE = """
import json, sys, time
import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, Imu, PointCloud2

rclpy.init()
node = rclpy.create_node("driver")
commands = node.create_publisher(TwistStamped, "/car_0/cmd_vel", 10)
heard = {"clock": [], "truth": [], "imu": [], "points": [], "image": []}

def ns(stamp):
    return stamp.sec * 10**9 + stamp.nanosec

def on_clock(message):
    heard["clock"].append(ns(message.clock))
    command = TwistStamped()
    command.header.stamp = message.clock
    command.twist.linear.x = 8.0
    commands.publish(command)

best = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
node.create_subscription(Clock, "/clock", on_clock, best)
node.create_subscription(Odometry, "/car_0/truth", lambda m: heard["truth"].append(
    (ns(m.header.stamp), m.header.frame_id, m.child_frame_id, m.twist.twist.linear.x)), 100)
node.create_subscription(Imu, "/car_0/imu", lambda m: heard["imu"].append(
    (ns(m.header.stamp), m.linear_acceleration.z)), 500)
node.create_subscription(PointCloud2, "/car_0/roof/points", lambda m: heard["points"].append(
    (ns(m.header.stamp), m.width, len(m.data))), 50)
node.create_subscription(Image, "/car_0/front/image_raw", lambda m: heard["image"].append(
    (ns(m.header.stamp), m.encoding, m.height, m.width, len(m.data))), 50)
nodes = set()
began, end = time.time(), time.time() + 60.0
while time.time() < end:
    rclpy.spin_once(node, timeout_sec=0.2)
    nodes |= set(node.get_node_names())
    if heard["clock"] and time.time() > began + 2.0 and not node.count_publishers("/clock"):
        break
print(json.dumps({**heard, "nodes": sorted(nodes)}))
"""


def start(python: str, domain: int) -> subprocess.Popen[str]:
    command = [python, "-c", textwrap.dedent(NODE)]
    environment = ros_environment(domain)
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


@pytest.mark.integration
@pytest.mark.skipif(not PYTHONS, reason="rclpy is not installed: set CAVMARL_RCLPY_PYTHON")
@pytest.mark.parametrize("python", PYTHONS)
def test_an_rclpy_node_drives_in_lock_step(python: str, domain: int, run_bridge: Run) -> None:
    steps = 400
    with start(python, domain) as node:
        options = RosOptions(domain=domain, truth=True, deadline_s=10.0)
        report, _ = run_bridge(options, steps)
        output, _ = node.communicate(timeout=60.0)
    heard: dict[str, Any] = json.loads(output.splitlines()[-1])
    counts = report["controls"]["car_0"]
    assert counts["used"] == steps + 1
    assert counts["late"] == counts["held"] == counts["old"] == counts["invalid"] == 0
    assert {"cavmarl", "driver"} <= set(heard["nodes"])
    # no gap between the first message and the last
    for name, period_ns in (
        ("truth", 50_000_000), ("imu", 10_000_000), ("points", 100_000_000), ("image", 100_000_000),
    ):  # fmt: skip
        stamps = [one[0] for one in heard[name]]
        assert len(stamps) > 0.9 * steps * 50_000_000 / period_ns, name
        assert stamps == list(range(stamps[0], stamps[-1] + 1, period_ns)), name
    assert heard["truth"][-1][1:3] == ["map", "car_0/base_link"]
    assert heard["truth"][-1][3] == pytest.approx(8.0, abs=0.1)
    assert all(size == 16 * width for _, width, size in heard["points"])
    assert heard["image"][0][1:] == ["rgb8", 18, 32, 18 * 32 * 3]
    assert heard["clock"] == sorted(heard["clock"])
