"""`REFERENCE_RIG`: the sensors that the reference stack drives with, as keys of `env.yaml`."""

from __future__ import annotations

from typing import Any

# Noise of consumer-grade parts: a GNSS receiver without corrections, a MEMS inertial unit, wheel
# encoders, a camera that looks for lane markings, and a lidar at the height of a bumper.
REFERENCE_RIG: dict[str, dict[str, Any]] = {
    "gnss": {"type": "gnss", "rate_hz": 10, "noise": [1.0, 1.0, 2.0], "z_m": 1.5},
    "imu": {
        "type": "imu",
        "rate_hz": 100,
        "noise": [0.05, 0.05, 0.05, 0.003, 0.003, 0.003],
    },
    "odometry": {"type": "odometry", "rate_hz": 20, "noise": [0.05, 0.01, 0.1]},
    "markings": {
        "type": "lane_boundary",
        "rate_hz": 20,
        "noise": [0.05, 0.05, 0.05, 0.01, 0.001],
    },
    "lidar": {
        "type": "lidar",
        "rate_hz": 10,
        "rays": 360,
        "range_m": 60.0,
        "noise": [0.02],
        "z_m": 0.6,
    },
}
