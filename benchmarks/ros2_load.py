"""Clouds, pictures and inertial samples from a world to a node of ROS 2: how many are lost.

The node uses `rclpy` in a Python that `CAVMARL_RCLPY_PYTHON` names (`make ros2` makes two, for
Jazzy and Kilted). It has reliable subscriptions, and the profile of Fast DDS in
`cavmarl/cosim/ros2/fast_dds.xml`.
"""

from __future__ import annotations

import json
import subprocess
import time
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

from benchmarks import ros2_load_node
from benchmarks.program import run
from benchmarks.ros2_clock import JOINS_S, STEP_S, rclpy_python, ros_environment
from benchmarks.ros2_load_node import CLOUD, IMU, PICTURE
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import OptionalEnvironment, about, with_world
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import EvaluationError
from cavmarl.cosim.ros2.bridged_world import BridgedWorld
from cavmarl.cosim.ros2.ros_bridge import RosOptions
from cavmarl.cosim.time_master import RealTime
from cavmarl.env.parallel import parallel_env

_RATES_HZ = {CLOUD: 10.0, PICTURE: 20.0, IMU: 100.0}
_READY_S = 8.0  # time to discover the node and its subscriptions
_ARRIVES_S = 1.0  # time for the last messages to arrive
RIG: dict[str, dict[str, Any]] = {
    # All 64,000 rays meet the ground.
    "roof": {
        "type": "lidar",
        "rate_hz": _RATES_HZ[CLOUD],
        "z_m": 1.4,
        "layers": 64,
        "rays": 1000,
        "lower_deg": -25.0,
        "upper_deg": -2.0,
        "range_m": 60.0,
    },
    "front": {
        "type": "rgb_camera",
        "rate_hz": _RATES_HZ[PICTURE],
        "z_m": 1.4,
        "width": 640,
        "height": 360,
    },
    "imu": {"type": "imu", "rate_hz": _RATES_HZ[IMU]},
    "wheels": {"type": "odometry", "rate_hz": 20.0},
}


@with_world("agents", "background", "seed", "settings")
def measure(
    world: WorldSpec,
    env: OptionalEnvironment = "grid4x4",
    steps: Annotated[int, about("Steps of the world; a step is 50 ms.")] = 1600,
    pace: Annotated[float, about("Simulated seconds per second; 0: as fast as possible.")] = 1.0,
    domain: Annotated[int, about("ROS_DOMAIN_ID.")] = 91,
    say: Say = silent,
) -> BenchmarkReport:
    """Send clouds of 64,000 points, pictures of 640 x 360 and an IMU to a node of ROS 2."""
    say(f"{steps} steps")
    rows, wall_s = send(world, steps=steps, pace=pace, domain=domain)
    total = sum(row["sent"] for row in rows)
    lost = sum(row["lost"] for row in rows)
    return BenchmarkReport(
        f"{Path(world.env).name}, rclpy",
        {
            "topic": "topic",
            "Hz": "rate_hz:g",
            "sent": "sent:d",
            "received": "received:d",
            "lost": "lost:d",
            "bytes per message": "bytes:d",
        },
        rows,
        [f"{total} messages in {steps * STEP_S:g} s of simulated and {wall_s:.0f} s of real time"],
        {"messages": total, "lost": lost, "wall_s": wall_s},
        holds=lost == 0,
    )


def send(
    spec: WorldSpec, *, steps: int, pace: float, domain: int
) -> tuple[list[dict[str, Any]], float]:
    """Run a world, a bridge in a thread, and a node of `rclpy` in a process.

    Returns one row per topic, and the wall time of the steps.

    Raises:
        ConfigError: no Python with `rclpy` is named.
        EvaluationError: the node fails.
        FollowerError, RosError: the bridge fails.
    """
    check_range(steps=(steps, 1, float("inf")), pace=(pace, 0.0, float("inf")))
    python = rclpy_python()
    overrides = {
        "population.mode": "respawn",
        **spec.overrides,
        "rig": RIG,
        "clock.sim_dt_s": STEP_S,
        "clock.ctrl_dt_s": STEP_S,
        "horizon_s": STEP_S * (steps + 2),
    }
    options = RosOptions(domain=domain, ready_s=_READY_S, deadline_s=0.0)
    command = [python, str(ros2_load_node.__file__)]
    environment = ros_environment(domain)
    with (
        closing(parallel_env(spec.env, **{**spec.keywords, "overrides": overrides})) as env,
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as node,
    ):
        try:
            pacer = RealTime(pace) if pace else None
            with BridgedWorld(env, ["car_0"], options, pacer=pacer) as bridged:
                bridged.world.reset(spec.seed)
                began_s = time.monotonic()
                for _ in range(steps):
                    bridged.world.step()
                wall_s = time.monotonic() - began_s
                time.sleep(_ARRIVES_S)
            output, _ = node.communicate(timeout=JOINS_S)
        finally:
            node.kill()
        if node.returncode:
            raise EvaluationError(f"the node has ended with {node.returncode}; see its output")
    heard: dict[str, list[list[int]]] = json.loads(output)
    return [_row(topic, heard[topic], bridged.report["sent"]) for topic in _RATES_HZ], wall_s


def _row(topic: str, heard: list[list[int]], sent: dict[str, int]) -> dict[str, Any]:
    stamps = {stamp for stamp, _ in heard}
    return {
        "topic": topic,
        "rate_hz": _RATES_HZ[topic],
        "sent": sent.get(topic, 0),
        "received": len(stamps),
        "lost": sent.get(topic, 0) - len(stamps),
        "bytes": max((size for _, size in heard), default=0),
    }


if __name__ == "__main__":
    run(measure)
