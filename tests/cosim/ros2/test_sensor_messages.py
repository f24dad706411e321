"""Compare sensor samples in ROS messages with transforms and projections computed here."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.cosim.followers.follower_messages import SensorView
from cavmarl.cosim.ros2.ros_topics import RosClock, VehicleTopics, read_names
from cavmarl.cosim.ros2.ros_types import RosTypes
from cavmarl.cosim.ros2.sensor_messages import (
    POINT,
    SENSORS,
    TARGET,
    markers,
    mount_transforms,
    odometry,
    quaternion_of,
    true_state,
    turn_of,
)
from cavmarl.driving.kernels.motion.bicycle import bicycle_step
from tests.cosim.ros2.conftest import RIG

PLACE = dict.fromkeys(("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg"), 0.0)


def rotate(quaternion: dict[str, float], point: Any) -> NDArray[np.float64]:
    """Rotate a point as ROS does, by q · p · q*."""
    x, y, z, w = (quaternion[name] for name in "xyzw")
    axis, given = np.array([x, y, z]), np.asarray(point, dtype=np.float64)
    return given + 2.0 * np.cross(axis, np.cross(axis, given) + w * given)


@pytest.mark.parametrize("heading_deg", [0.0, 37.0, 90.0, 179.0, 180.0, -135.0])
@pytest.mark.parametrize("pitch_deg", [0.0, 12.0, -80.0])
@pytest.mark.parametrize("roll_deg", [0.0, 170.0, -25.0])
def test_a_quaternion_rotates_points_by_its_angles(
    heading_deg: float, pitch_deg: float, roll_deg: float
) -> None:
    heading, pitch, roll = map(math.radians, (heading_deg, pitch_deg, roll_deg))
    found = quaternion_of(turn_of(heading, pitch, roll))
    assert math.isclose(sum(value * value for value in found.values()), 1.0)
    # yaw, then pitch (nose up is positive), then roll (left side up is positive)
    c, s = math.cos, math.sin
    yaw_turn = np.array([[c(heading), -s(heading), 0], [s(heading), c(heading), 0], [0, 0, 1]])
    nose_up = np.array([[c(pitch), 0, -s(pitch)], [0, 1, 0], [s(pitch), 0, c(pitch)]])
    left_up = np.array([[1, 0, 0], [0, c(roll), -s(roll)], [0, s(roll), c(roll)]])
    for point in np.eye(3):
        want = yaw_turn @ nose_up @ left_up @ point
        np.testing.assert_allclose(rotate(found, point), want, atol=1e-12)


def test_pitch_is_positive_uphill_in_cavmarl_and_nose_down_in_ros() -> None:
    found = quaternion_of(turn_of(0.0, 0.1))
    assert found["y"] < 0.0
    assert rotate(found, (1.0, 0.0, 0.0))[2] > 0.0


def test_sensors_are_placed_from_the_rear_axle() -> None:
    settings = PLACE | {"type": "imu", "x_m": 1.0, "y_m": -0.2, "z_m": 1.6, "yaw_deg": 90.0}
    (found,) = mount_transforms(settings, 5, "base_link", "imu", 2.8)
    move = found["transform"]
    assert (found["header"]["frame_id"], found["child_frame_id"]) == ("base_link", "imu")
    assert move["translation"] == {"x": 2.4, "y": -0.2, "z": 1.6}
    np.testing.assert_allclose(rotate(move["rotation"], (1, 0, 0)), (0, 1, 0), atol=1e-12)


def test_a_camera_has_an_optical_frame_with_z_forward() -> None:
    settings = PLACE | {"type": "rgb_camera"}
    _, found = mount_transforms(settings, 5, "base_link", "front", 2.8)
    assert found["child_frame_id"] == "front_optical_link"
    turn = found["transform"]["rotation"]
    np.testing.assert_allclose(rotate(turn, (0, 0, 1)), (1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(rotate(turn, (1, 0, 0)), (0, -1, 0), atol=1e-12)
    np.testing.assert_allclose(rotate(turn, (0, 1, 0)), (0, 0, -1), atol=1e-12)


def make_messages(kind: str, sample: Any, **settings: Any) -> list[dict[str, Any]]:
    make = SENSORS[kind][0]
    given = PLACE | {"type": kind, "noise": [0.0]} | settings
    return [one.fields for one in make(given, np.asarray(sample), 1_250_000_000, "frame")]


def test_points_are_in_the_frame_of_the_lidar_and_rays_without_echo_are_left_out() -> None:
    scan = np.full((2, 4), 50.0, dtype=np.float32)
    scan[1, 1] = 10.0  # upper layer, to the left
    scan[0, 2] = 5.0  # lower layer, behind
    keys = {"fov_deg": 360.0, "lower_deg": 0.0, "upper_deg": 30.0, "range_m": 50.0, "z_m": 1.6}
    (fields,) = make_messages("lidar", scan, **keys)
    points = np.frombuffer(fields["data"].tobytes(), POINT)
    assert (fields["width"], fields["height"], fields["point_step"]) == (2, 1, 16)
    assert fields["row_step"] == len(fields["data"]) == 32
    assert [(one["name"], one["offset"], one["datatype"]) for one in fields["fields"]] == [
        ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 2), ("return_type", 13, 2),
        ("channel", 14, 4),
    ]  # fmt: skip
    lower, upper = points
    np.testing.assert_allclose([lower[n] for n in "xyz"], (-5.0, 0.0, 0.0), atol=1e-5)
    want = (0.0, 10.0 * math.cos(math.pi / 6), 5.0)
    np.testing.assert_allclose([upper[n] for n in "xyz"], want, atol=1e-5)
    assert (lower["channel"], upper["channel"]) == (0, 1)


def test_targets_of_a_radar_have_places_and_radial_speeds() -> None:
    rows = np.zeros((3, 3), dtype=np.float32)
    rows[0] = 20.0, math.pi / 2, -3.0
    (fields,) = make_messages("radar", rows)
    (target,) = np.frombuffer(fields["data"].tobytes(), TARGET)
    np.testing.assert_allclose(list(target), (0.0, 20.0, 0.0, -3.0), atol=1e-5)


def test_a_camera_message_has_intrinsics_and_rows_from_the_top() -> None:
    picture = np.arange(2 * 4 * 3, dtype=np.uint8).reshape(2, 4, 3)
    image, info = make_messages("rgb_camera", picture, fov_deg=90.0)
    assert (image["encoding"], image["step"]) == ("rgb8", 12)
    assert image["data"].tobytes() == picture.tobytes()
    assert image["header"]["frame_id"] == info["header"]["frame_id"] == "frame_optical_link"
    # With a field of view of 90°, a point at the right edge is as far to the side as ahead.
    k = np.reshape(info["k"], (3, 3))
    u, v, w = k @ np.array([1.0, 0.0, 1.0])
    assert (u / w, v / w) == (4.0, 1.0)
    np.testing.assert_array_equal(np.reshape(info["p"], (3, 4))[:, :3], k)


def test_depths_are_floats_in_m_and_classes_are_bytes() -> None:
    depth, _ = make_messages(
        "depth_camera", np.array([[1.5, 100.0]], dtype=np.float16), fov_deg=60.0
    )
    assert depth["encoding"] == "32FC1"
    assert np.frombuffer(depth["data"].tobytes(), "<f4").tolist() == [1.5, 100.0]
    classes, _ = make_messages("semantic_camera", np.array([[3, 7]], dtype=np.uint8), fov_deg=60.0)
    assert (classes["encoding"], classes["data"].tobytes()) == ("mono8", b"\3\7")


def test_inertial_and_satellite_measurements_keep_values_and_noise() -> None:
    noise = [0.1, 0.2, 0.3, 0.01, 0.02, 0.03]
    (imu,) = make_messages("imu", [0.5, -0.25, 9.81, 0.1, 0.2, -0.3], noise=noise)
    assert imu["linear_acceleration"]["z"] == 9.81
    assert imu["angular_velocity"] == {"x": 0.1, "y": 0.2, "z": -0.3}
    assert imu["orientation_covariance"][0] == -1.0
    diagonal = np.diag(np.reshape(imu["angular_velocity_covariance"], (3, 3)))
    np.testing.assert_allclose(np.sqrt(diagonal), noise[3:])
    (fix,) = make_messages("gnss", [48.0, 11.5, 512.0], noise=[2.0])
    assert (fix["latitude"], fix["longitude"], fix["altitude"]) == (48.0, 11.5, 512.0)
    assert fix["position_covariance"] == [4.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 4.0]
    assert fix["header"]["stamp"] == {"sec": 1, "nanosec": 250_000_000}


def test_the_velocity_at_the_rear_axle_has_no_lateral_part() -> None:
    wheelbase_m, dt = 2.7, 1e-6
    row = dict.fromkeys(("z", "pitch", "accel", "agent", "id"), 0.0)
    row |= {"x": 3.0, "y": -2.0, "heading": 0.6, "speed": 7.0, "steering": 0.35}
    state = true_state(row, wheelbase_m)
    x, y, heading, _, yaw_rate = bicycle_step(3.0, -2.0, 0.6, 7.0, 0.0, 0.35, wheelbase_m, dt)
    after = true_state(row | {"x": x, "y": y, "heading": heading}, wheelbase_m)
    velocity = (after.place - state.place) / dt
    ahead = velocity[0] * math.cos(0.6) + velocity[1] * math.sin(0.6)
    aside = velocity[1] * math.cos(0.6) - velocity[0] * math.sin(0.6)
    assert abs(aside) < 1e-4
    assert math.isclose(ahead, state.speed_mps, rel_tol=1e-5)
    assert math.isclose(yaw_rate, state.yaw_rate_radps, rel_tol=1e-9)
    told = odometry(state, 7, "base_link")
    assert told["twist"]["twist"]["linear"]["x"] == state.speed_mps
    assert (told["header"]["frame_id"], told["child_frame_id"]) == ("map", "base_link")


def test_boxes_of_vehicles_stand_on_the_road() -> None:
    row = {"id": 2.0**32 + 5, "agent": -1.0, "x": 1.0, "y": 2.0, "z": 4.0, "heading": 0.0}
    row |= {"pitch": 0.0, "length": 5.0, "width": 2.0, "height": 1.6}
    (box,) = markers([row], 3, 10**8)["markers"]
    assert box["pose"]["position"] == {"x": 1.0, "y": 2.0, "z": 4.8}
    assert box["scale"] == {"x": 5.0, "y": 2.0, "z": 1.6}
    assert box["id"] == 5


def views(*names: str) -> list[SensorView]:
    return [SensorView(name, [], PLACE | RIG[name]) for name in names]


def test_the_names_of_sensors_are_read_from_a_file(tmp_path: Any) -> None:
    file = tmp_path / "kit.yaml"
    file.write_text("roof: {frame: velodyne_top, topic: /sensing/lidar/top/points}\n")
    topics = VehicleTopics("car_0", views("roof", "imu"), "autoware", read_names(file), False)
    assert "/sensing/lidar/top/points" in topics.kinds
    assert "/sensing/imu/imu/imu_raw" in topics.kinds
    assert [one["child_frame_id"] for one in topics.mounts(0, 2.8)] == ["velodyne_top", "imu"]
    with pytest.raises(ConfigError, match=r"no sensor 'roof'; choose among imu"):
        VehicleTopics("car_0", views("imu"), "plain", read_names(file), False)
    file.write_text("roof: {frames: velodyne_top}\n")
    with pytest.raises(ConfigError, match="must contain sensors with names"):
        read_names(file)


def test_two_sensors_cannot_have_one_topic() -> None:
    names = {"roof": {"topic": "/same"}, "imu": {"topic": "/same"}}
    with pytest.raises(ConfigError, match="imu: another sensor has the topic /same"):
        VehicleTopics("car_0", views("roof", "imu"), "plain", names, False)


def test_sensors_without_a_ros_message_are_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    grid = SensorView("grid", [], PLACE | {"type": "bev_grid"})
    topics = VehicleTopics("car_0", [grid, *views("imu")], "plain", {}, False)
    assert list(topics.kinds) == ["/car_0/imu", "/car_0/goal"]
    assert "1 sensors have no ROS message and are not published: grid (bev_grid)" in caplog.text


def test_ros_time_increases_across_episodes_in_whole_ns() -> None:
    clock = RosClock(0.05, 2)
    clock.set(0, 0)
    for tick in (3, 7):
        clock.set(0, tick)
        assert clock.now_ns == tick * 50_000_000
    clock.set(1, 0)
    assert clock.now_ns == 7 * 50_000_000 + 100_000_000
    assert clock.ns_of(0.1) == clock.now_ns + 100_000_000


@pytest.mark.parametrize("distro", ["humble", "jazzy", "kilted"])
def test_message_types_equal_the_distributions(distro: str) -> None:
    types = RosTypes(distro)
    image, info = make_messages("rgb_camera", np.zeros((2, 4, 3), np.uint8), fov_deg=90.0)
    for kind, fields in (
        ("sensor_msgs/msg/Image", image),
        ("sensor_msgs/msg/CameraInfo", info),
        ("visualization_msgs/msg/MarkerArray", markers([], 0, 0)),
    ):
        again = types.decode(kind, types.encode(kind, fields))
        assert types.store.serialize_cdr(again, kind) == types.encode(kind, fields)
    with pytest.raises(ValueError, match="has no field 'heigth'"):
        types.encode("sensor_msgs/msg/Image", {"heigth": 3})
    with pytest.raises(ValueError, match="7 bytes are not a sensor_msgs/msg/Image"):
        types.decode("sensor_msgs/msg/Image", b"\0\1\0\0abc")


def test_other_distributions_are_refused() -> None:
    with pytest.raises(ConfigError, match="must be one of humble, jazzy, kilted"):
        RosTypes("foxy")
