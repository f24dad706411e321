"""A stand-in for Autoware, which drives a vehicle with only topics and a map folder.

    python -m benchmarks.topic_driver FOLDER --domain N

The program subscribes to the clock, odometry, traffic lights, predicted objects and the
destination. It publishes `autoware_control_msgs/msg/Control` with the time of each clock message.
From cavmarl, it uses the DDS node, the message types and path tracking. When the last publisher of
the clock is gone, the program prints one line of JSON: the number of steps for each reason of its
acceleration.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.map_driver import WHEELBASE_M, MapDriver, Seen
from benchmarks.vector_map import VectorMap
from cavmarl.cosim.ros2.dds_node import DdsNode
from cavmarl.cosim.ros2.ros_types import RosTypes, ns_of, time_of
from cavmarl.cosim.stack.stack_types import EgoPose

CLOCK = "/clock"
ODOMETRY = "/localization/kinematic_state"
LIGHTS = "/perception/traffic_light_recognition/traffic_signals"
OBJECTS = "/perception/object_recognition/objects"
GOAL = "/planning/mission_planning/goal"
KINDS = {
    CLOCK: "rosgraph_msgs/msg/Clock",
    ODOMETRY: "nav_msgs/msg/Odometry",
    LIGHTS: "autoware_perception_msgs/msg/TrafficLightGroupArray",
    OBJECTS: "autoware_perception_msgs/msg/PredictedObjects",
    GOAL: "geometry_msgs/msg/PoseStamped",
}
CONTROL, CONTROL_KIND = "/control/command/control_cmd", "autoware_control_msgs/msg/Control"
ENDS_S = 3.0  # the program ends after this time without a publisher of the clock
MISSES_S = 5.0  # the driver reports messages that are missing for this time


class TopicDriver:
    """The node with its received messages.

    `step_s`: simulated time between two messages of the clock.
    """

    def __init__(self, folder: Path, domain: int, step_s: float) -> None:
        self._types = RosTypes()
        self._driver = MapDriver(VectorMap(folder), step_s)
        self._node = DdsNode(self._types, "topic_driver", domain, {CONTROL: CONTROL_KIND}, KINDS)
        self._newest: dict[str, Any] = {}
        self.reasons: Counter[str] = Counter()

    def run(self) -> None:
        """Answer each clock message until the last publisher of the clock is gone."""
        silent_s, answered_ns, due_s = 0.0, -1, math.inf
        while answered_ns < 0 or silent_s < ENDS_S:
            began_s = time.monotonic()
            self._node.wait(0.2)
            if not self._hear():
                is_gone = self._node.publishers_of(CLOCK) == 0
                silent_s = silent_s + time.monotonic() - began_s if is_gone else 0.0
                continue
            silent_s = 0.0
            clock = self._newest.get(CLOCK)
            if clock is None or ns_of(clock.clock) <= answered_ns:
                continue
            if missing := self._missing(ns_of(clock.clock)):
                due_s = min(due_s, time.monotonic() + MISSES_S)
                if time.monotonic() > due_s:
                    due_s = math.inf
                    print(f"missing at {clock.clock}: {', '.join(missing)}", file=sys.stderr)
                continue
            due_s, answered_ns = math.inf, ns_of(clock.clock)
            self._answer(answered_ns)
        self._node.close()

    def _hear(self) -> bool:
        """Read new messages; a new destination begins a new way."""
        is_new = False
        for topic, kind in KINDS.items():
            for received in self._node.take(topic):
                is_new = True
                message = self._types.decode(kind, received.data)
                self._newest[topic] = message
                if topic == GOAL:
                    at = message.pose
                    heading = 2.0 * math.atan2(at.orientation.z, at.orientation.w)
                    self._driver.begin(np.array([at.position.x, at.position.y]), heading)
        return is_new

    def _missing(self, now_ns: int) -> list[str]:
        """Return topics without a message of this time; messages of topics come in any order."""
        found = [topic for topic in KINDS if topic not in self._newest]
        for topic in (ODOMETRY, OBJECTS, LIGHTS):
            if topic in self._newest:
                message = self._newest[topic]
                stamp = message.stamp if topic == LIGHTS else message.header.stamp
                if ns_of(stamp) < now_ns:
                    found.append(topic)
        return found

    def _answer(self, now_ns: int) -> None:
        odometry = self._newest[ODOMETRY]
        heading, x, y = _pose_of(odometry.pose.pose)
        pose = EgoPose(
            x + 0.5 * WHEELBASE_M * math.cos(heading),
            y + 0.5 * WHEELBASE_M * math.sin(heading),
            heading,
            odometry.twist.twist.linear.x,
            odometry.twist.twist.angular.z,
        )
        lights = {
            group.traffic_light_group_id: frozenset(one.color for one in group.elements)
            for group in self._newest[LIGHTS].traffic_light_groups
        }
        objects = [_seen(one) for one in self._newest[OBJECTS].objects]
        accel, steering = self._driver.drive(pose, objects, lights)
        self.reasons[self._driver.reason] += 1
        stamp = time_of(now_ns)
        fields = {
            "stamp": stamp,
            "lateral": {"stamp": stamp, "steering_tire_angle": steering},
            "longitudinal": {
                "stamp": stamp,
                "velocity": max(0.0, pose.speed_mps + accel),
                "acceleration": accel,
                "is_defined_acceleration": True,
            },
        }
        self._node.publish(CONTROL, self._types.encode(CONTROL_KIND, fields))


def _pose_of(pose: Any) -> tuple[float, float, float]:
    """Return heading, x and y of a `geometry_msgs/msg/Pose`."""
    turn = pose.orientation
    east = 1.0 - 2.0 * (turn.y * turn.y + turn.z * turn.z)
    heading = math.atan2(2.0 * (turn.w * turn.z + turn.x * turn.y), east)
    return heading, pose.position.x, pose.position.y


def _seen(one: Any) -> Seen:
    kinematics, size = one.kinematics, one.shape.dimensions
    heading, x, y = _pose_of(kinematics.initial_pose_with_covariance.pose)
    speed = kinematics.initial_twist_with_covariance.twist.linear.x
    return Seen(np.array([x, y]), heading, speed, size.x, size.y)


def main(
    folder: Path,
    domain: Annotated[int, typer.Option(help="ROS_DOMAIN_ID.")] = 0,
    step_s: Annotated[float, typer.Option(help="Simulated seconds per clock message.")] = 0.1,
) -> None:
    """Drive with topics and the map in FOLDER."""
    driver = TopicDriver(folder, domain, step_s)
    driver.run()
    print(json.dumps(driver.reasons))


if __name__ == "__main__":
    typer.run(main)
