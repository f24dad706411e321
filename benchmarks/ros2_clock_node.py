"""A node of ROS 2 that answers each clock message with a command that has the same time.

    python ros2_clock_node.py

The program needs `rclpy` and nothing of cavmarl. When the last publisher of the clock is gone, it
prints one line of JSON: the received times of the clock, in ns.
"""

from __future__ import annotations

import json
from typing import Any

JOINS_S = 0.2


def main() -> None:
    import rclpy  # type: ignore[import-not-found, unused-ignore]
    from geometry_msgs.msg import TwistStamped  # type: ignore[import-not-found, unused-ignore]
    from rclpy.qos import (  # type: ignore[import-not-found, unused-ignore]
        QoSProfile,
        ReliabilityPolicy,
    )
    from rosgraph_msgs.msg import Clock  # type: ignore[import-not-found, unused-ignore]

    rclpy.init()
    node = rclpy.create_node("clock_reader")
    commands = node.create_publisher(TwistStamped, "/car_0/cmd_vel", 10)
    heard: list[int] = []

    def on_clock(message: Any) -> None:
        heard.append(message.clock.sec * 10**9 + message.clock.nanosec)
        command = TwistStamped()
        command.header.stamp = message.clock
        command.twist.linear.x = 8.0
        commands.publish(command)

    best = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_subscription(Clock, "/clock", on_clock, best)
    while not heard or node.count_publishers("/clock"):
        rclpy.spin_once(node, timeout_sec=JOINS_S)
    print(json.dumps(heard))


if __name__ == "__main__":
    main()
