"""A bridge between a world and nodes of ROS 2, over DDS on the loopback interface."""

from __future__ import annotations

import math
import threading
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError, FollowerError, RecordingError, RosError
from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.cosim.followers.follower_client import Follower
from cavmarl.cosim.ros2.dds_node import DdsNode
from cavmarl.cosim.ros2.ros_bridge import RosOptions, join
from cavmarl.cosim.ros2.ros_controls import SPEED_TIME_S
from cavmarl.cosim.ros2.ros_types import RosTypes
from tests.cosim.ros2.conftest import Driver, Run, cruise, make_env

pytestmark = pytest.mark.integration

CLOCK = "rosgraph_msgs/msg/Clock"
HEARD = {
    "/car_0/roof/points": "sensor_msgs/msg/PointCloud2",
    "/car_0/front/image_raw": "sensor_msgs/msg/Image",
    "/car_0/imu": "sensor_msgs/msg/Imu",
    "/car_0/truth": "nav_msgs/msg/Odometry",
    "/car_0/wheels": "geometry_msgs/msg/TwistStamped",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/vehicles": "visualization_msgs/msg/MarkerArray",
}


def stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def test_a_node_drives_in_lock_step(types: RosTypes, domain: int, run_bridge: Run) -> None:
    steps = 60
    with Driver(types, domain, HEARD) as driver:
        report, _ = run_bridge(RosOptions(domain=domain, truth=True), steps)
        driver.wait_for("/car_0/truth", steps)
    counts = report["controls"]["car_0"]
    assert (counts["used"], counts["held"], counts["late"]) == (steps + 1, 0, 0)
    truths = driver.heard["/car_0/truth"]
    # one message per step, with the time of the step's tick
    stamps = [stamp_ns(one) for one in truths]
    assert np.diff(stamps).tolist() == [50_000_000] * (len(stamps) - 1)
    speeds = [one.twist.twist.linear.x for one in truths]
    assert abs(speeds[0] - 8.0) > 1.0
    assert speeds[-1] == pytest.approx(8.0, abs=0.1)
    assert report["time_s"] == pytest.approx(0.05 * steps)
    for topic, count in (("/car_0/imu", 5 * steps), ("/car_0/roof/points", steps // 2)):
        assert len(driver.heard[topic]) >= count - 10, topic
    # The odometry of this rig has no error, so measured speeds equal the true speeds.
    measured = {stamp_ns(one): one.twist.linear.x for one in driver.heard["/car_0/wheels"]}
    for one in truths[10:]:
        if stamp_ns(one) in measured:
            assert math.isclose(measured[stamp_ns(one)], one.twist.twist.linear.x, abs_tol=0.3)


def test_a_bridge_drives_bit_for_bit_like_a_follower_with_the_same_controls(
    types: RosTypes, domain: int, run_bridge: Run, tmp_path: Path
) -> None:
    with Driver(types, domain):
        _, bridged = run_bridge(RosOptions(domain=domain), 40)
    place = tmp_path / "socket"
    with closing(make_env()) as env, FollowedWorld(env, place) as world:

        def follow() -> None:
            speed = 0.0
            with Follower(str(place), ["car_0"]) as follower:
                most = follower.welcome.acceleration_mps2, follower.welcome.steering_rad
                for view in follower:
                    seen = view.snapshot.vehicles["car_0"]
                    if "wheels" in view.sensors["car_0"]:
                        speed = float(view.sensors["car_0"]["wheels"].values[-1][0])
                    push = min(max((8.0 - speed) / SPEED_TIME_S, -most[0]), most[0])
                    angle = math.atan(seen.wheelbase_m * 0.1 / 8.0)
                    given = [push / most[0], angle / most[1]]
                    follower.answer({"car_0": [min(max(one, -1.0), 1.0) for one in given]})

        thread = threading.Thread(target=follow, daemon=True)
        thread.start()
        world.wait_for(1, 20.0)
        world.reset(seed=3)
        for _ in range(40):
            world.step()
        assert env.state_hash() == bridged
    thread.join(10.0)


def test_a_bridge_with_autowares_topics_drives_bit_for_bit_like_a_follower(
    types: RosTypes, domain: int, run_bridge: Run, tmp_path: Path
) -> None:
    def wave(tick: int) -> tuple[float, float]:
        """Return acceleration and steering angle, rounded to single precision as in a message."""
        return float(np.float32(math.sin(0.7 * tick))), float(np.float32(0.1 * math.cos(tick)))

    def control(stamp: int) -> dict[str, Any]:
        time_ = {"sec": stamp // 10**9, "nanosec": stamp % 10**9}
        push, angle = wave(stamp // 50_000_000)
        given = {"acceleration": push, "is_defined_acceleration": True}
        return {"stamp": time_, "longitudinal": given, "lateral": {"steering_tire_angle": angle}}

    commands = "/control/command/control_cmd", "autoware_control_msgs/msg/Control"
    with Driver(types, domain, None, control, commands):
        options = RosOptions(domain=domain, profile="autoware", truth=True)
        report, bridged = run_bridge(options, 40)
    assert report["controls"]["car_0"]["used"] == 41
    place = tmp_path / "socket"
    with closing(make_env()) as env, FollowedWorld(env, place) as world:

        def follow() -> None:
            with Follower(str(place), ["car_0"]) as follower:
                most = follower.welcome.acceleration_mps2, follower.welcome.steering_rad
                for view in follower:
                    push, angle = wave(view.snapshot.tick)
                    follower.answer({"car_0": [push / most[0], angle / most[1]]})

        thread = threading.Thread(target=follow, daemon=True)
        thread.start()
        world.wait_for(1, 20.0)
        world.reset(seed=3)
        for _ in range(40):
            world.step()
        assert env.state_hash() == bridged
    thread.join(10.0)


def test_without_commands_the_vehicle_brakes_and_a_warning_is_logged(
    domain: int, run_bridge: Run, caplog: pytest.LogCaptureFixture
) -> None:
    report, _ = run_bridge(RosOptions(domain=domain, ready_s=0.2, deadline_s=0.0), 5)
    counts = report["controls"]["car_0"]
    assert (counts["held"], counts["used"], counts["received"]) == (6, 0, 0)
    assert "no node publishes commands for car_0" in caplog.text
    # No node listens, so the bridge sends only the clock and messages that it keeps for late nodes.
    assert report["sent"] == {"/tf_static": 1, "/car_0/goal": 1, "/clock": 1}


def test_the_bridge_waits_for_a_missing_command_until_the_deadline(
    types: RosTypes, domain: int, run_bridge: Run
) -> None:
    def answer_with_time_0(stamp: int) -> dict[str, Any]:
        return cruise(0)

    with Driver(types, domain, answer=answer_with_time_0):
        began_s = time.monotonic()
        report, _ = run_bridge(RosOptions(domain=domain, deadline_s=0.1), 5)
        assert time.monotonic() - began_s > 0.5
    counts = report["controls"]["car_0"]
    assert counts["late"] == counts["held"] == 5
    assert counts["used"] == 1  # the command with time 0


def test_a_lag_of_one_step_allows_the_command_of_the_previous_step(
    types: RosTypes, domain: int, run_bridge: Run
) -> None:
    def answer_previous(stamp: int) -> dict[str, Any]:
        return cruise(max(stamp - 50_000_000, 0))

    with Driver(types, domain, answer=answer_previous):
        report, _ = run_bridge(RosOptions(domain=domain, lag_steps=1), 10)
    assert report["controls"]["car_0"]["used"] == 11
    assert report["controls"]["car_0"]["late"] == 0


def test_in_mode_newest_the_bridge_never_waits(
    types: RosTypes, domain: int, run_bridge: Run
) -> None:
    def never(stamp: int) -> dict[str, Any]:
        return cruise(0)

    options = RosOptions(domain=domain, wait="newest", deadline_s=30.0)
    with Driver(types, domain, answer=never):
        began_s = time.monotonic()
        report, _ = run_bridge(options, 20)
        assert time.monotonic() - began_s < 25.0
    counts = report["controls"]["car_0"]
    assert counts["used"] + counts["held"] == 21
    assert counts["late"] == 0


def test_the_time_of_ros_increases_over_a_new_episode(
    types: RosTypes, domain: int, tmp_path: Path
) -> None:
    with (
        Driver(types, domain, {"/car_0/truth": HEARD["/car_0/truth"]}) as driver,
        closing(make_env()) as env,
        FollowedWorld(env, tmp_path / "s", timeout_s=40.0, truth=True) as world,
    ):
        options = RosOptions(domain=domain, truth=True)
        thread = threading.Thread(
            target=join, args=(str(tmp_path / "s"), ["car_0"], options), daemon=True
        )
        thread.start()
        world.wait_for(1, 20.0)
        for seed in (1, 2):
            world.reset(seed=seed)
            for _ in range(5):
                world.step()
        driver.wait_for("/car_0/truth", 10)
    thread.join(10.0)
    stamps = [stamp_ns(one) for one in driver.heard["/car_0/truth"]]
    assert np.diff(stamps).tolist() == [50_000_000] * (len(stamps) - 1)
    assert len(stamps) >= 10


def test_a_second_clock_is_refused(types: RosTypes, domain: int, run_bridge: Run) -> None:
    with closing(DdsNode(types, "rogue", domain, {"/clock": CLOCK}, {})) as rogue:
        time.sleep(0.5)
        rogue.publish("/clock", types.encode(CLOCK, {"clock": {"sec": 9}}))
        with pytest.raises(RosError, match=r"1 other nodes publish /clock on domain \d+: only the"):
            run_bridge(RosOptions(domain=domain, ready_s=2.0, deadline_s=0.2), 30)


def test_two_bridges_cannot_drive_one_vehicle(domain: int, tmp_path: Path) -> None:
    with closing(make_env()) as env, FollowedWorld(env, tmp_path / "s") as world:
        options = RosOptions(domain=domain, ready_s=0.0, deadline_s=0.0)

        def attach() -> None:
            errors.append(None)
            try:
                join(str(tmp_path / "s"), ["car_0"], options)
            except FollowerError as error:
                errors[-1] = error

        errors: list[Any] = []
        threads = [threading.Thread(target=attach, daemon=True) for _ in range(2)]
        threads[0].start()
        world.wait_for(1, 20.0)
        threads[1].start()
        while threads[1].is_alive():
            world.admit(0.1)
        world.reset(seed=1)
    for thread in threads:
        thread.join(20.0)
    assert "car_0 is driven by 'ros2'" in str(errors[1])


def test_true_states_are_refused_unless_the_world_allows_them(domain: int, tmp_path: Path) -> None:
    errors: list[str] = []
    with closing(make_env()) as env, FollowedWorld(env, tmp_path / "s") as world:

        def attach() -> None:
            try:
                join(str(tmp_path / "s"), ["car_0"], RosOptions(domain=domain, truth=True))
            except FollowerError as error:
                errors.append(str(error))

        thread = threading.Thread(target=attach, daemon=True)
        thread.start()
        while thread.is_alive():
            world.admit(0.1)
    assert "requests the true state of all vehicles" in errors[0]


@pytest.mark.parametrize(
    ("options", "more", "message"),
    [
        ({}, {"rig": {"imu": {"type": "imu", "rate_hz": 20}}}, "do not measure their speed"),
        ({}, {"action.kind": "discrete"}, "commands of ROS are continuous"),
        ({"domain": 102}, {}, "domain = 102: must be from 0 to 101"),
        ({"names": {"rof": {"frame": "x"}}}, {}, "no sensor 'rof'; choose among roof, front"),
    ],
)
def test_unsupported_options_and_worlds_are_refused(
    options: Any, more: Any, message: str, domain: int, run_bridge: Run
) -> None:
    with pytest.raises(ConfigError, match=message):
        run_bridge(RosOptions(**{"domain": domain, **options}), 1, **more)


def test_two_vehicles_are_refused_by_a_profile_for_one_vehicle(
    domain: int, run_bridge: Run
) -> None:
    options = RosOptions(domain=domain, profile="autoware")
    with pytest.raises(ConfigError, match="2 vehicles: Autoware's topic names allow one vehicle"):
        run_bridge(options, 1, ("car_0", "car_1"))


@pytest.mark.parametrize("key", ["deadline_s", "ready_s"])
def test_options_that_are_nan_or_negative_are_refused(key: str) -> None:
    with pytest.raises(ConfigError, match=f"{key} = nan: must be finite and at least 0"):
        RosOptions(**{key: math.nan})
    with pytest.raises(ConfigError, match="lag_steps = -1: must be at least 0"):
        RosOptions(lag_steps=-1)


def test_commands_in_autowares_topics_drive_a_vehicle(
    types: RosTypes, domain: int, run_bridge: Run
) -> None:
    heard = {
        "/localization/kinematic_state": "nav_msgs/msg/Odometry",
        "/vehicle/status/velocity_status": "autoware_vehicle_msgs/msg/VelocityReport",
        "/vehicle/status/steering_status": "autoware_vehicle_msgs/msg/SteeringReport",
        "/vehicle/status/gear_status": "autoware_vehicle_msgs/msg/GearReport",
        "/vehicle/status/control_mode": "autoware_vehicle_msgs/msg/ControlModeReport",
        "/sensing/lidar/roof/pointcloud_before_sync": "sensor_msgs/msg/PointCloud2",
    }

    def control(stamp: int) -> dict[str, Any]:
        time_ = {"sec": stamp // 10**9, "nanosec": stamp % 10**9}
        given = {"acceleration": 1.5, "is_defined_acceleration": True}
        return {"stamp": time_, "longitudinal": given, "lateral": {"steering_tire_angle": 0.05}}

    commands = "/control/command/control_cmd", "autoware_control_msgs/msg/Control"
    with Driver(types, domain, heard, control, commands) as driver:
        options = RosOptions(domain=domain, profile="autoware", truth=True)
        report, _ = run_bridge(options, 40)
        for topic in heard:
            driver.wait_for(topic)
        driver.wait_for("/vehicle/status/velocity_status", 35)
    assert report["controls"]["car_0"]["used"] == 41
    velocities = driver.heard["/vehicle/status/velocity_status"]
    gained = velocities[-1].longitudinal_velocity - velocities[-21].longitudinal_velocity
    assert gained == pytest.approx(1.5, abs=0.05)  # the last 20 steps take 1 s
    angle = driver.heard["/vehicle/status/steering_status"][-1].steering_tire_angle
    assert angle == pytest.approx(0.05, abs=1e-3)
    assert driver.heard["/vehicle/status/gear_status"][-1].report == 2
    assert driver.heard["/vehicle/status/control_mode"][-1].mode == 1
    assert velocities[-1].header.frame_id == "base_link"


def test_a_bag_has_the_messages_that_were_sent(
    types: RosTypes, domain: int, run_bridge: Run, tmp_path: Path
) -> None:
    from rosbags.rosbag2 import Reader

    bag = tmp_path / "bag"
    with Driver(types, domain, HEARD) as driver:
        report, _ = run_bridge(RosOptions(domain=domain, truth=True, bag=bag), 20)
        driver.wait_for("/car_0/truth", 20)
    written: dict[str, list[tuple[int, bytes]]] = {}
    with Reader(bag) as reader:
        for connection, when_ns, data in reader.messages():
            written.setdefault(connection.topic, []).append((when_ns, bytes(data)))
        kinds = {one.topic: one.msgtype for one in reader.connections}
        hashes = {one.topic: one.digest for one in reader.connections}
    assert {topic: len(found) for topic, found in written.items()} == report["sent"]
    for topic, kind in HEARD.items():
        assert kinds[topic] == kind
        assert hashes[topic] == types.type_hash(kind)
        known = {data for _, data in written[topic]}
        # DDS pads messages to a multiple of four bytes
        assert all(any(got.startswith(one) for one in known) for got in driver.data[topic]), topic
    clocks = [when_ns for when_ns, _ in written["/clock"]]
    assert clocks == [50_000_000 * step for step in range(21)]
    with pytest.raises(RecordingError, match="a bag cannot be made there"):
        run_bridge(RosOptions(domain=domain, bag=bag, ready_s=0.0), 1)


def test_foxgloves_reader_reads_the_bag(
    types: RosTypes, domain: int, run_bridge: Run, tmp_path: Path
) -> None:
    mcap = pytest.importorskip("mcap_ros2.reader", reason="needs mcap-ros2-support")
    bag = tmp_path / "bag"
    with Driver(types, domain, {"/car_0/imu": HEARD["/car_0/imu"]}) as driver:
        run_bridge(RosOptions(domain=domain, truth=True, bag=bag), 10)
        driver.wait_for("/car_0/imu", 40)
    (file,) = bag.glob("*.mcap")
    found: dict[str, list[Any]] = {}
    for one in mcap.read_ros2_messages(str(file)):
        found.setdefault(one.channel.topic, []).append(one.ros_msg)
    gravities = [one.linear_acceleration.z for one in found["/car_0/imu"]]
    assert np.mean(gravities) == pytest.approx(9.81, abs=0.1)
    (mounts,) = found["/tf_static"]
    names = [one.child_frame_id for one in mounts.transforms]
    assert names == ["car_0/roof", "car_0/front", "car_0/front_optical_link", "car_0/imu",
                     "car_0/gnss"]  # fmt: skip
    cloud = found["/car_0/roof/points"][-1]
    assert len(cloud.data) == 16 * cloud.width > 0
