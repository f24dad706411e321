"""The clocks of a world and of a node of ROS 2 that drives in it, through the bridge.

The node uses `rclpy` in a Python that `CAVMARL_RCLPY_PYTHON` names (`make ros2` makes two, for
Jazzy and Kilted). In a share of the steps, the bridge can tick by itself, like the bridge of paper
B (`docs/explanation/papers.md`).
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from fractions import Fraction
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Literal

from benchmarks import ros2_clock_node
from benchmarks.carla_clock_client import is_due
from benchmarks.clock_drift import ClockDrift, drift_report, noticed_after, rows_of
from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import OptionalEnvironment, about, with_world
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ClockError, ConfigError, EvaluationError
from cavmarl.cosim.followers.follower_client import Follower
from cavmarl.cosim.followers.follower_connection import Address
from cavmarl.cosim.followers.follower_messages import PoseView
from cavmarl.cosim.ros2 import FAST_DDS_PROFILE
from cavmarl.cosim.ros2.bridged_world import BridgedWorld
from cavmarl.cosim.ros2.ros_bridge import RosOptions
from cavmarl.cosim.time_master import OwnTicks
from cavmarl.env.parallel import parallel_env

PYTHON = "CAVMARL_RCLPY_PYTHON"
JOINS_S = 60.0
STEP_S = 0.05
RIG = {"wheels": {"type": "odometry", "rate_hz": 20}}


@with_world("agents", "background", "seed", "settings")
def measure(
    world: WorldSpec,
    env: OptionalEnvironment = "grid4x4",
    steps: Annotated[int, about("Steps of the world; a step is one tick.")] = 5000,
    rogue: Annotated[float, about("Share of steps in which the bridge also ticks.")] = 0.0,
    own_ticks: Annotated[
        Literal["obey", "refuse", "ignore"], about("How the world treats the bridge's ticks.")
    ] = "obey",
    domain: Annotated[int, about("ROS_DOMAIN_ID.")] = 90,
    say: Say = silent,
) -> BenchmarkReport:
    """Compare the clocks of a world and of a node of ROS 2, in lock step (Table II of paper B)."""
    say(f"{steps} steps")
    found, report = measure_ros_drift(
        world, steps=steps, rogue=rogue, own_ticks=own_ticks, domain=domain
    )
    counts = ", ".join(f"{count} {name}" for name, count in report["controls"].items() if count)
    return drift_report(
        found,
        f"{found.environment}, rclpy, {1000.0 * found.dt_s:g} ms per step",
        ("world", "node"),
        [
            f"{report['steps_per_s']:.0f} steps/s of the wall clock; commands: {counts}",
            f"the bridge ticked {found.own_ticks} times (own ticks: {found.answer}); the master "
            f"detected {found.drift_events} times that the world had advanced without it",
        ],
        report,
    )


class _RogueFollower(Follower):
    """A follower that also ticks in a share of the steps."""

    share = Fraction(0)
    answers = own_ticks = 0

    def answer(
        self,
        controls: Mapping[str, Any] | None = None,
        poses: Mapping[str, Sequence[PoseView]] | None = None,
    ) -> None:
        self.answers += 1
        if is_due(self.answers, self.share):
            self.own_ticks += 1
            try:
                self.tick()
            except ClockError:
                pass
        super().answer(controls, poses)


def measure_ros_drift(
    spec: WorldSpec, *, steps: int, rogue: float, own_ticks: OwnTicks, domain: int
) -> tuple[ClockDrift, dict[str, Any]]:
    """Run a world, a bridge in a thread, and a node of `rclpy` in a process.

    Raises:
        ConfigError: no Python with `rclpy` is named.
        EvaluationError: the node fails.
        FollowerError, RosError: the bridge fails.
    """
    check_range(steps=(steps, 1, float("inf")), rogue=(rogue, 0.0, 1.0))
    python = rclpy_python()
    overrides = {
        "population.mode": "respawn",
        "rig": RIG,
        **spec.overrides,
        "clock.sim_dt_s": STEP_S,
        "clock.ctrl_dt_s": STEP_S,
        "horizon_s": STEP_S * (2 * steps + 2),
    }
    rogues: list[_RogueFollower] = []

    def follow(address: Address) -> Follower:
        rogues.append(_RogueFollower(address, ["car_0"], "ros2"))
        rogues[-1].share = Fraction(str(rogue))
        return rogues[-1]

    options = RosOptions(domain=domain, deadline_s=10.0, ready_s=JOINS_S)
    keywords = {**spec.keywords, "overrides": overrides}
    with closing(parallel_env(spec.env, **keywords)) as env, _node(python, domain) as node:
        try:
            with BridgedWorld(
                env, ["car_0"], options, own_ticks=own_ticks, follow=follow
            ) as bridged:
                clock, wall_s = _run(bridged, spec.seed, steps)
            output, _ = node.communicate(timeout=JOINS_S)
        finally:
            node.kill()
        if node.returncode:
            raise EvaluationError(f"the node has ended with {node.returncode}; see its output")
        master = bridged.world.master
    # A waiting bridge repeats its clock.
    stamps = [ns for ns, _ in groupby(json.loads(output))]
    heard = [round(ns / (1e9 * STEP_S)) for ns in stamps]
    drift = ClockDrift(
        environment=Path(spec.env).name,
        dt_s=STEP_S,
        rogue=rogue,
        answer=own_ticks,
        pace=None,
        rows=rows_of([tick - clock[0] for tick in clock], heard, STEP_S),
        own_ticks=rogues[0].own_ticks,
        counted=master.own_ticks,
        drift_events=master.drifts,
        noticed_ticks=noticed_after(master),
    )
    return drift, {
        "steps_per_s": steps / wall_s,
        "controls": bridged.report["controls"]["car_0"],
        "wait_wall_s": bridged.report["wait_wall_s"],
    }


def _run(bridged: BridgedWorld, seed: int, steps: int) -> tuple[list[int], float]:
    """Return the master's tick at the beginning and after each step, and the wall time."""
    world = bridged.world
    world.reset(seed)
    clock = [world.master.tick]
    began_s = time.monotonic()
    for _ in range(steps):
        world.step()
        clock.append(world.master.tick)
    wall_s = time.monotonic() - began_s
    world.master.look_for_drift()
    return clock, wall_s


def rclpy_python() -> str:
    """Return the first Python with `rclpy` that the environment variable names.

    Raises ConfigError: it names none.
    """
    python = os.environ.get(PYTHON, "").split(":")[0]
    if not python:
        raise ConfigError(f"{PYTHON}: name a Python with rclpy; `make ros2` makes one")
    return python


def ros_environment(domain: int) -> dict[str, str]:
    """Return the environment of a process of ROS 2 that reaches bridges of this machine."""
    profile = str(FAST_DDS_PROFILE)
    return {
        **{name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        "FASTDDS_DEFAULT_PROFILES_FILE": profile,
        "FASTRTPS_DEFAULT_PROFILES_FILE": profile,  # its name in Jazzy
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }


def _node(python: str, domain: int) -> subprocess.Popen[str]:
    command = [python, str(ros2_clock_node.__file__)]
    environment = ros_environment(domain)
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


if __name__ == "__main__":
    run(measure)
