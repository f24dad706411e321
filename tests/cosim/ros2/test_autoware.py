"""Traffic lights, objects, destination and requests in the topics of Autoware."""

from __future__ import annotations

import logging
import math
from typing import Any

import numpy as np
import pytest

from cavmarl.core.records.codes import SIGNAL_NONE
from cavmarl.cosim.ros2.autoware_messages import (
    PATH_S,
    PATH_STEP_S,
    detected_objects,
    light_groups,
    predicted_objects,
)
from cavmarl.cosim.ros2.autoware_requests import AutowareRequests
from cavmarl.cosim.ros2.dds_node import DdsNode
from cavmarl.cosim.ros2.ros_bridge import RosOptions
from cavmarl.cosim.ros2.ros_types import RosTypes
from cavmarl.cosim.ros2.sensor_messages import true_state
from cavmarl.maps.exports.lanelet import FIRST_LIGHT
from cavmarl.roads.network import SIGNAL_STATES, VEHICLE_CLASSES
from tests.cosim.ros2.conftest import Driver, Run

LIGHTS = "/perception/traffic_light_recognition/traffic_signals"
OBJECTS = "/perception/object_recognition/objects"
DETECTED = "/perception/object_recognition/detection/objects"
GOAL = "/planning/mission_planning/goal"
POSE = "/sensing/gnss/pose_with_covariance"
STATE = "/localization/initialization_state"
KINDS = {
    LIGHTS: "autoware_perception_msgs/msg/TrafficLightGroupArray",
    OBJECTS: "autoware_perception_msgs/msg/PredictedObjects",
    DETECTED: "autoware_perception_msgs/msg/DetectedObjects",
    GOAL: "geometry_msgs/msg/PoseStamped",
    POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    STATE: "autoware_adapi_v1_msgs/msg/LocalizationInitializationState",
    "/signals": "std_msgs/msg/UInt8MultiArray",
    "/vehicles": "visualization_msgs/msg/MarkerArray",
    "/localization/kinematic_state": "nav_msgs/msg/Odometry",
    "/vehicle/status/turn_indicators_status": "autoware_vehicle_msgs/msg/TurnIndicatorsReport",
    "/vehicle/status/hazard_lights_status": "autoware_vehicle_msgs/msg/HazardLightsReport",
}
CONTROL = "/control/command/control_cmd", "autoware_control_msgs/msg/Control"

# Each letter of SUMO's signal states, with the (color, shape, status) of Autoware's elements.
SHOWN = {
    "r": [(1, 5, 14)],
    "u": [(1, 5, 14), (2, 5, 14)],
    "y": [(2, 5, 14)],
    "Y": [(2, 5, 14)],
    "g": [(3, 5, 14)],
    "G": [(3, 5, 14)],
    "s": [(1, 5, 14)],
    "o": [(2, 5, 15)],
    "O": [(16, 5, 13)],
}


def vehicle(**more: float) -> dict[str, float]:
    row = {
        "id": 300, "agent": -1, "vclass": VEHICLE_CLASSES.index("bus"), "x": 10.0, "y": 20.0,
        "z": 1.0, "heading": 0.5 * math.pi, "pitch": 0.0, "speed": 8.0, "accel": -0.5,
        "steering": 0.0, "length": 12.0, "width": 2.5, "height": 3.0,
    }  # fmt: skip
    return {**row, **more}


def control_fields(stamp: int) -> dict[str, Any]:
    time_ = {"sec": stamp // 10**9, "nanosec": stamp % 10**9}
    return {"stamp": time_, "longitudinal": {"acceleration": 1.0, "is_defined_acceleration": True}}


def encode_and_decode(types: RosTypes, kind: str, fields: dict[str, Any]) -> Any:
    return types.decode(kind, types.encode(kind, fields))


def test_each_state_of_a_signal_becomes_its_light_elements(types: RosTypes) -> None:
    codes = np.array([*range(len(SIGNAL_STATES)), SIGNAL_NONE], dtype=np.uint8)
    found = encode_and_decode(types, KINDS[LIGHTS], light_groups(codes, 5 * 10**9 + 7))
    assert (found.stamp.sec, found.stamp.nanosec) == (5, 7)
    groups = found.traffic_light_groups
    # a link without a signal has no group
    assert [one.traffic_light_group_id - FIRST_LIGHT for one in groups] == list(
        range(len(SIGNAL_STATES))
    )
    for letter, group in zip(SIGNAL_STATES, groups, strict=True):
        assert [(one.color, one.shape, one.status) for one in group.elements] == SHOWN[letter]
        assert {one.confidence for one in group.elements} == {1.0}


def test_objects_have_class_shape_and_path(types: RosTypes) -> None:
    rows = [vehicle(), vehicle(id=301, vclass=0, speed=0.0, heading=0.0, pitch=0.1)]
    found = encode_and_decode(types, KINDS[OBJECTS], predicted_objects(rows, 10**9))
    bus, car = found.objects
    assert found.header.frame_id == "map"
    assert (bus.classification[0].label, car.classification[0].label) == (3, 1)
    assert int.from_bytes(bytes(bus.object_id.uuid), "little") == 300
    size = bus.shape.dimensions
    assert (bus.shape.type, size.x, size.y, size.z) == (0, 12.0, 2.5, 3.0)
    begin = bus.kinematics.initial_pose_with_covariance.pose
    assert (begin.position.x, begin.position.y, begin.position.z) == (10.0, 20.0, 2.5)
    assert begin.orientation.z == pytest.approx(math.sin(math.pi / 4))
    assert bus.kinematics.initial_twist_with_covariance.twist.linear.x == 8.0
    assert bus.kinematics.initial_acceleration_with_covariance.accel.linear.x == -0.5
    (path,) = bus.kinematics.predicted_paths
    places = np.array([(at.position.x, at.position.y) for at in path.path])
    times_s = np.arange(round(PATH_S / PATH_STEP_S) + 1) * PATH_STEP_S
    assert (path.time_step.sec, path.time_step.nanosec) == (0, 500_000_000)
    np.testing.assert_allclose(places, np.stack([10.0 + 0 * times_s, 20.0 + 8.0 * times_s], 1))
    assert path.path[-1].orientation.z == pytest.approx(begin.orientation.z)
    detected = encode_and_decode(types, KINDS[DETECTED], detected_objects(rows, 10**9)).objects
    assert [one.kinematics.pose_with_covariance.pose for one in detected] == [
        one.kinematics.initial_pose_with_covariance.pose for one in found.objects
    ]
    assert detected[0].kinematics.orientation_availability == 2


def test_the_predicted_path_of_a_turning_object_is_a_circle() -> None:
    row = vehicle(steering=0.3, length=4.5)
    (found,) = predicted_objects([row], 0)["objects"]
    kinematics = found["kinematics"]
    (path,) = kinematics["predicted_paths"]
    places = np.array([[at["position"][axis] for axis in "xy"] for at in path["path"]])
    yaw_rate = kinematics["initial_twist_with_covariance"]["twist"]["angular"]["z"]
    radius_m = row["speed"] / yaw_rate
    slip = math.atan(0.5 * math.tan(0.3))
    course = row["heading"] + slip
    middle = places[0] + radius_m * np.array([-math.sin(course), math.cos(course)])
    # each chord has the length of an arc, so the polygon is a little larger than the circle
    np.testing.assert_allclose(np.hypot(*(places - middle).T), radius_m, rtol=0.2)
    turned = 2.0 * math.asin(path["path"][1]["orientation"]["z"]) - row["heading"]
    assert turned == pytest.approx(PATH_STEP_S * yaw_rate)


def test_messages_have_the_lights_objects_and_destination_of_the_world(
    types: RosTypes, domain: int, run_bridge: Run
) -> None:
    with Driver(types, domain, KINDS, control_fields, CONTROL) as driver:
        options = RosOptions(domain=domain, profile="autoware", truth=True)
        report, _ = run_bridge(options, 30)
        for topic in KINDS:
            driver.wait_for(topic)
        driver.wait_for("/signals", 25)
    heard = driver.heard
    shown = heard["/signals"][-1].data
    groups = {
        one.traffic_light_group_id - FIRST_LIGHT: one
        for one in heard[LIGHTS][-1].traffic_light_groups
    }
    assert groups.keys() == set(np.flatnonzero(shown != SIGNAL_NONE).tolist())
    assert len(groups) == 256
    for link, group in groups.items():
        seen = [(one.color, one.shape, one.status) for one in group.elements]
        assert seen == SHOWN[SIGNAL_STATES[shown[link]]]
    boxes = {one.id: one for one in heard["/vehicles"][-1].markers}
    own = heard["/localization/kinematic_state"][-1].pose.pose.position
    objects = heard[OBJECTS][-1].objects
    ids = [int.from_bytes(bytes(one.object_id.uuid), "little") for one in objects]
    places = [one.kinematics.initial_pose_with_covariance.pose for one in objects]
    assert places == [boxes[one].pose for one in ids]
    near = {
        one
        for one, box in boxes.items()
        if math.dist((own.x, own.y), (box.pose.position.x, box.pose.position.y)) < 98.0
    }
    (ego,) = near - set(ids)
    assert boxes[ego].color.r > 0.5
    assert len(heard[DETECTED][-1].objects) == len(objects)
    # the destination is the end of a road that leads out of the grid
    (goal,) = heard[GOAL]
    assert goal.header.frame_id == "map"
    x, y = goal.pose.position.x, goal.pose.position.y
    assert min(x, y, 600.0 - x, 600.0 - y) < 5.0
    course = 2.0 * math.atan2(goal.pose.orientation.z, goal.pose.orientation.w)
    # the destination points out of the grid
    assert (x - 300.0) * math.cos(course) + (y - 300.0) * math.sin(course) > 290.0
    assert heard[POSE][-1].pose.pose.position == own
    assert [one.state for one in heard[STATE]] == [3]
    assert report["requests"]["car_0"]["/initialpose"] == {
        "accepted": 0, "refused": 0, "invalid": 0,
    }  # fmt: skip


POSES = "geometry_msgs/msg/PoseWithCovarianceStamped"
GEARS = "autoware_vehicle_msgs/msg/GearCommand"
TURNS = "autoware_vehicle_msgs/msg/TurnIndicatorsCommand"


def pose(x: float, y: float, heading: float, frame: str = "map") -> dict[str, Any]:
    turn = {"z": math.sin(0.5 * heading), "w": math.cos(0.5 * heading)}
    at = {"position": {"x": x, "y": y}, "orientation": turn}
    return {"header": {"frame_id": frame}, "pose": {"pose": at}}


@pytest.mark.parametrize(
    ("topic", "kind", "fields", "refusal"),
    [
        ("/initialpose", POSES, pose(10.5, 18.0, 1.4), ""),
        ("/initialpose", POSES, pose(10.5, 28.0, 1.4), "10.0 m and 0.17 rad from the true pose; "),
        ("/initialpose", POSES, pose(10.0, 18.0, 0.0), "1.57 rad from the true pose; the world"),
        ("/initialpose", POSES, pose(10.0, 18.0, 1.4, "odom"), "the frame must be map"),
        ("/control/command/gear_cmd", GEARS, {"command": 2}, ""),
        ("/control/command/gear_cmd", GEARS, {"command": 20}, "gear 20: only DRIVE"),
    ],
)
def test_requests_are_accepted_or_refused(
    topic: str, kind: str, fields: dict[str, Any], refusal: str, types: RosTypes
) -> None:
    requests = AutowareRequests(types, truth=True)
    state = true_state(vehicle(y=20.0), wheelbase_m=4.0)  # the rear axle is at y = 18
    found = requests.take(topic, types.encode(kind, fields), state)
    assert refusal in found
    assert bool(found) == bool(refusal)
    counts = requests.counts[topic]
    assert (counts.accepted, counts.refused) == (int(not refusal), int(bool(refusal)))


def test_the_vehicle_reports_its_turn_and_hazard_lights_as_commanded(types: RosTypes) -> None:
    requests = AutowareRequests(types, truth=False)
    assert "/initialpose" not in requests.topics
    topic = "/control/command/turn_indicators_cmd"
    assert (requests.turn_indicators, requests.hazard_lights) == (1, 1)
    for command, shown in ((2, 2), (0, 2), (9, 2), (3, 3), (1, 1)):
        assert requests.take(topic, types.encode(TURNS, {"command": command}), None) == ""
        assert requests.turn_indicators == shown
    requests.take(topic, b"junk", None)
    assert (requests.counts[topic].accepted, requests.counts[topic].invalid) == (4, 2)


def test_a_repeated_refusal_is_logged_once(
    types: RosTypes, domain: int, run_bridge: Run, caplog: pytest.LogCaptureFixture
) -> None:
    sent = {"/initialpose": POSES, "/control/command/turn_indicators_cmd": TURNS}
    place = types.encode(POSES, pose(-1000.0, 0.0, 0.0))
    left = types.encode(TURNS, {"command": 2})
    with DdsNode(types, "rviz", domain, sent, {}) as rviz:

        def answer(stamp: int) -> dict[str, Any]:
            rviz.publish("/initialpose", place)
            rviz.publish("/control/command/turn_indicators_cmd", left)
            return control_fields(stamp)

        with (
            caplog.at_level(logging.WARNING),
            Driver(types, domain, KINDS, answer, CONTROL) as driver,
        ):
            options = RosOptions(domain=domain, profile="autoware", truth=True)
            report, _ = run_bridge(options, 30)
            driver.wait_for("/vehicle/status/turn_indicators_status", 20)
    counts = report["requests"]["car_0"]
    assert counts["/initialpose"]["refused"] > 10
    assert counts["/initialpose"]["accepted"] == 0
    assert counts["/control/command/turn_indicators_cmd"]["accepted"] > 10
    assert driver.heard["/vehicle/status/turn_indicators_status"][-1].report == 2
    assert driver.heard["/vehicle/status/hazard_lights_status"][-1].report == 1
    said = [one for one in caplog.messages if "/initialpose" in one]
    assert len(said) == 1
    assert "later refusals are only counted" in said[0]
