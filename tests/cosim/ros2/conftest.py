"""Worlds with a ROS 2 bridge, and a node that uses its topics."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

import cavmarl

pytest.importorskip("rosbags", reason="needs the extra 'ros2'")
pytest.importorskip("cyclonedds", reason="needs the extra 'ros2'")

from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.cosim.ros2.dds_node import DdsNode
from cavmarl.cosim.ros2.ros_bridge import RosOptions, join
from cavmarl.cosim.ros2.ros_types import RosTypes

RIG: dict[str, dict[str, Any]] = {
    "roof": {"type": "lidar", "rate_hz": 10, "z_m": 1.6, "layers": 4, "rays": 90, "range_m": 60},
    "front": {
        "type": "rgb_camera",
        "rate_hz": 10,
        "x_m": 1.0,
        "z_m": 1.5,
        "width": 32,
        "height": 18,
    },
    "imu": {"type": "imu", "rate_hz": 100, "noise": [0.02]},
    "gnss": {"type": "gnss", "rate_hz": 5, "noise": [0.5]},
    "wheels": {"type": "odometry", "rate_hz": 20},
}
DRIVE = "/car_0/cmd_vel"
TWIST = "geometry_msgs/msg/TwistStamped"


@pytest.fixture(scope="session")
def types() -> RosTypes:
    return RosTypes()


@pytest.fixture
def domain() -> int:
    """Return a DDS domain for this process; tests in other processes may run at the same time."""
    return 10 + os.getpid() % 80


def make_env(env: str = "grid4x4", agents: int = 1, **more: Any) -> cavmarl.CavEnv:
    overrides = {"clock.ctrl_dt_s": 0.05, "rig": RIG, **more}
    return cavmarl.parallel_env(env, agents=agents, background=8, overrides=overrides)


Run = Callable[..., tuple[dict[str, Any], str]]


@pytest.fixture
def run_bridge(tmp_path: Path) -> Iterator[Run]:
    """Return a function that runs a world with a bridge and returns its report and state hash."""
    threads: list[threading.Thread] = []

    def run(
        options: RosOptions, steps: int, vehicles: tuple[str, ...] = ("car_0",), **more: Any
    ) -> tuple[dict[str, Any], str]:
        reports: list[Any] = []

        def follow() -> None:
            try:
                reports.append(join(str(tmp_path / "s"), vehicles, options))
            except cavmarl.CavmarlError as error:
                reports.append(error)

        with (
            closing(make_env(agents=len(vehicles), **more)) as env,
            FollowedWorld(env, tmp_path / "s", timeout_s=40.0, truth=options.truth) as world,
        ):
            threads.append(threading.Thread(target=follow, daemon=True))
            threads[-1].start()
            try:
                world.wait_for(1, 20.0)
                world.reset(seed=3)
                for _ in range(steps):
                    world.step()
                found = env.state_hash()
            except cavmarl.CavmarlError:
                threads[-1].join(20.0)
                raise (reports or [TimeoutError("the bridge runs on")])[0] from None
        threads[-1].join(20.0)
        if isinstance(reports[0], Exception):
            raise reports[0]
        return reports[0], found

    yield run
    for thread in threads:
        assert not thread.is_alive()


class Driver:
    """A node that answers each clock message with a command of the same time."""

    def __init__(
        self,
        types: RosTypes,
        domain: int,
        heard: dict[str, str] | None = None,
        answer: Callable[[int], dict[str, Any]] | None = None,
        commands: tuple[str, str] = (DRIVE, TWIST),
    ) -> None:
        self.types, self.commands = types, commands
        self.heard: dict[str, list[Any]] = {topic: [] for topic in heard or {}}
        self.data: dict[str, list[bytes]] = {topic: [] for topic in heard or {}}
        self._kinds = heard or {}
        self._answer = answer or cruise
        clock = {"/clock": "rosgraph_msgs/msg/Clock"}
        self.node = DdsNode(types, "driver", domain, dict([commands]), {**clock, **self._kinds})
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __enter__(self) -> Driver:
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.set()
        self._thread.join(10.0)
        self.node.close()

    def _run(self) -> None:
        topic, kind = self.commands
        while not self._ends.is_set():
            self.node.wait(0.05)
            for name in self._kinds:
                for received in self.node.take(name):
                    self.data[name].append(received.data)
                    self.heard[name].append(self.types.decode(self._kinds[name], received.data))
            for received in self.node.take("/clock"):
                stamp = self.types.decode("rosgraph_msgs/msg/Clock", received.data).clock
                fields = self._answer(stamp.sec * 10**9 + stamp.nanosec)
                self.node.publish(topic, self.types.encode(kind, fields))

    def wait_for(self, topic: str, count: int = 1) -> None:
        end_s = time.monotonic() + 10.0
        while len(self.heard[topic]) < count and time.monotonic() < end_s:
            time.sleep(0.01)
        assert len(self.heard[topic]) >= count, topic


def cruise(stamp_ns: int) -> dict[str, Any]:
    stamp = {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}
    twist = {"linear": {"x": 8.0}, "angular": {"z": 0.1}}
    return {"header": {"stamp": stamp, "frame_id": ""}, "twist": twist}
