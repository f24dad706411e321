"""A node of ROS 2 that receives clouds, pictures and inertial samples, and lists them.

    python ros2_load_node.py

The program needs `rclpy` and nothing of cavmarl. When the last publisher of `IMU` is gone, it
prints one line of JSON: for each topic, the stamps in ns and the number of bytes of its messages.
"""

from __future__ import annotations

import json
import time
from typing import Any

CLOUD, PICTURE, IMU = "/car_0/roof/points", "/car_0/front/image_raw", "/car_0/imu"
QUIET_S = 1.0  # time for the last messages to arrive


def main() -> None:
    import rclpy  # type: ignore[import-not-found, unused-ignore]
    from rclpy.qos import (  # type: ignore[import-not-found, unused-ignore]
        QoSProfile,
        ReliabilityPolicy,
    )
    from sensor_msgs.msg import (  # type: ignore[import-not-found, unused-ignore]
        Image,
        Imu,
        PointCloud2,
    )

    rclpy.init()
    node = rclpy.create_node("load_reader")
    heard: dict[str, list[tuple[int, int]]] = {}
    last_s = time.monotonic()

    def listen(kind: Any, topic: str) -> None:
        heard[topic] = []

        def take(message: Any) -> None:
            nonlocal last_s
            last_s = time.monotonic()
            stamp = message.header.stamp
            size = len(message.data) if hasattr(message, "data") else 0
            heard[topic].append((stamp.sec * 10**9 + stamp.nanosec, size))

        reliable = QoSProfile(depth=500, reliability=ReliabilityPolicy.RELIABLE)
        node.create_subscription(kind, topic, take, reliable)

    for kind, topic in ((PointCloud2, CLOUD), (Image, PICTURE), (Imu, IMU)):
        listen(kind, topic)
    while True:
        rclpy.spin_once(node, timeout_sec=0.2)
        is_over = any(heard.values()) and not node.count_publishers(IMU)
        if is_over and time.monotonic() - last_s > QUIET_S:
            break
    print(json.dumps(heard))


if __name__ == "__main__":
    main()
