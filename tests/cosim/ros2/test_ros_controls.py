"""Commands of ROS as controls of vehicles."""

from __future__ import annotations

import math
from typing import Any

import pytest

from cavmarl.cosim.followers.follower_messages import Welcome
from cavmarl.cosim.ros2.ros_controls import SPEED_TIME_S, VehicleControls
from cavmarl.cosim.ros2.ros_types import RosTypes

WHEELBASE_M = 2.7
TOPICS = {
    "drive": "/car_0/cmd_ackermann",
    "twist": "/car_0/cmd_vel",
    "control": "/control/command/control_cmd",
}
STAMP = {"sec": 1, "nanosec": 500}
NOW_NS = 1_000_000_500


@pytest.fixture
def controls(types: RosTypes, request: Any) -> VehicleControls:
    welcome = Welcome("e", "h", ["car_0"], 0, 0.05, 1, 0, "continuous", 5.0, 0.8, [])
    return VehicleControls("car_0", types, welcome, getattr(request, "param", True))


def take(controls: VehicleControls, types: RosTypes, topic: str, fields: dict[str, Any]) -> None:
    controls.take(topic, types.encode(controls.topics[topic], fields), WHEELBASE_M)


def drive(steering: float, speed: float, acceleration: float = 0.0, stamp: Any = None) -> Any:
    given = {"steering_angle": steering, "speed": speed, "acceleration": acceleration}
    return {"header": {"stamp": STAMP if stamp is None else stamp}, "drive": given}


def twist(speed: float, yaw_rate: float) -> Any:
    given = {"linear": {"x": speed}, "angular": {"z": yaw_rate}}
    return {"header": {"stamp": STAMP}, "twist": given}


def test_without_a_command_the_vehicle_brakes(controls: VehicleControls) -> None:
    assert controls.control(0, 10.0) == [-1.0, 0.0]
    assert (controls.counts.held, controls.counts.used) == (1, 0)


def test_a_speed_is_reached_with_a_time_constant(
    controls: VehicleControls, types: RosTypes
) -> None:
    take(controls, types, TOPICS["drive"], drive(0.4, 8.0))
    throttle, steering = controls.control(NOW_NS, 7.0)
    assert math.isclose(throttle, 1.0 / SPEED_TIME_S / 5.0)
    assert math.isclose(steering, 0.5, rel_tol=1e-6)
    assert math.isclose(controls.steering_rad, 0.4, rel_tol=1e-6)
    assert (controls.counts.used, controls.counts.limited) == (1, 0)
    # the acceleration of an Ackermann command limits the change of speed
    take(controls, types, TOPICS["drive"], drive(0.0, 8.0, 0.5))
    assert math.isclose(controls.control(NOW_NS, 7.0)[0], 0.1)
    assert math.isclose(controls.control(NOW_NS, 9.0)[0], -0.1)


def test_a_twist_sets_the_yaw_rate_at_the_rear_axle(
    controls: VehicleControls, types: RosTypes
) -> None:
    take(controls, types, TOPICS["twist"], twist(6.0, 0.5))
    controls.control(NOW_NS, 6.0)
    # the rear axle follows a circle of radius v / yaw rate; tan(steering) = wheelbase / radius
    assert math.isclose(math.tan(controls.steering_rad), WHEELBASE_M / 12.0, rel_tol=1e-6)
    take(controls, types, TOPICS["twist"], twist(0.0, -0.5))
    assert controls.control(NOW_NS, 0.0) == [0.0, -1.0]
    take(controls, types, TOPICS["twist"], twist(0.0, 0.0))
    assert controls.control(NOW_NS, 0.0) == [0.0, 0.0]


@pytest.mark.parametrize("controls", [False], indirect=True)
def test_a_command_of_autoware_sets_an_acceleration_or_a_speed(
    controls: VehicleControls, types: RosTypes
) -> None:
    given = {"velocity": 3.0, "acceleration": -2.0, "is_defined_acceleration": True}
    fields = {"stamp": STAMP, "longitudinal": given, "lateral": {"steering_tire_angle": -0.4}}
    take(controls, types, TOPICS["control"], fields)
    found = controls.control(NOW_NS, 10.0)
    assert found == pytest.approx([-0.4, -0.5])
    given["is_defined_acceleration"] = False
    take(controls, types, TOPICS["control"], fields)
    assert controls.control(NOW_NS, 3.5)[0] == pytest.approx(-0.5 / SPEED_TIME_S / 5.0)


@pytest.mark.parametrize(
    "fields",
    [drive(math.nan, 1.0), drive(0.0, math.inf), drive(0.0, 1.0, math.nan), drive(-math.inf, 0.0)],
)
def test_nan_and_infinite_commands_are_counted_and_not_used(
    controls: VehicleControls, types: RosTypes, fields: Any
) -> None:
    take(controls, types, TOPICS["drive"], drive(0.1, 5.0))
    before = controls.control(NOW_NS, 5.0)
    take(controls, types, TOPICS["drive"], fields)
    assert controls.control(NOW_NS, 5.0) == before
    assert (controls.counts.received, controls.counts.invalid) == (2, 1)


def test_garbage_and_old_commands_are_counted(controls: VehicleControls, types: RosTypes) -> None:
    take(controls, types, TOPICS["drive"], drive(0.1, 5.0))
    controls.take(TOPICS["drive"], b"\0\1\0\0\7", WHEELBASE_M)
    take(controls, types, TOPICS["drive"], drive(0.7, 5.0, stamp={"sec": 0, "nanosec": 9}))
    assert (controls.counts.invalid, controls.counts.old) == (1, 1)
    assert controls.control(NOW_NS, 5.0)[1] == pytest.approx(0.125)
    assert controls.counts.used == 1
    controls.control(NOW_NS + 1, 5.0)
    assert controls.counts.held == 1


def test_commands_beyond_the_limits_are_limited(controls: VehicleControls, types: RosTypes) -> None:
    take(controls, types, TOPICS["drive"], drive(1.2, -4.0))
    assert controls.control(NOW_NS, 1.0) == pytest.approx([-0.4, 1.0])  # there is no reverse gear
    assert controls.counts.limited == 1
    controls.forget()
    assert controls.control(0, 1.0) == [-1.0, 0.0]
