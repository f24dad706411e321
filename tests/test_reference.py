"""The motion models, compared with those of highway-env on its roads."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

with warnings.catch_warnings():
    # pygame uses a deprecated package.
    warnings.simplefilter("ignore", DeprecationWarning)
    warnings.simplefilter("ignore", UserWarning)
    pytest.importorskip("highway_env", reason="needs the extra 'bench'")

    from highway_env.road.lane import CircularLane, StraightLane
    from highway_env.road.road import Road, RoadNetwork
    from highway_env.vehicle.behavior import IDMVehicle
    from highway_env.vehicle.controller import ControlledVehicle
    from highway_env.vehicle.kinematics import Vehicle

from cavmarl.core.math.geometry import wrap_angle
from cavmarl.driving.kernels.lanes import lane_change
from cavmarl.driving.kernels.models import idm
from cavmarl.driving.kernels.motion import bicycle as kinematics
from cavmarl.driving.kernels.motion import highway_control as control
from tests.naive.kinematics import clip_control

IDM_DEFAULTS = (idm.ACCEL_MAX, idm.DECEL_COMFORT, idm.JAM_DISTANCE_M, idm.TIME_HEADWAY_S)


def test_default_parameters_equal_those_of_highway_env() -> None:
    assert IDMVehicle.COMFORT_ACC_MAX == idm.ACCEL_MAX
    assert -IDMVehicle.COMFORT_ACC_MIN == idm.DECEL_COMFORT
    assert IDMVehicle.DISTANCE_WANTED == idm.JAM_DISTANCE_M
    assert IDMVehicle.TIME_WANTED == idm.TIME_HEADWAY_S
    assert IDMVehicle.ACC_MAX == idm.ACCEL_LIMIT
    assert IDMVehicle.DELTA == 4.0
    assert IDMVehicle.POLITENESS == lane_change.POLITENESS
    assert IDMVehicle.LANE_CHANGE_MIN_ACC_GAIN == lane_change.MIN_ACCEL_GAIN
    assert IDMVehicle.LANE_CHANGE_MAX_BRAKING_IMPOSED == lane_change.MAX_BRAKING_IMPOSED
    assert IDMVehicle.LANE_CHANGE_DELAY == lane_change.LANE_CHANGE_DELAY_S
    assert ControlledVehicle.KP_A == control.KP_ACCEL
    assert ControlledVehicle.KP_HEADING == control.KP_HEADING
    assert ControlledVehicle.KP_LATERAL == control.KP_LATERAL
    assert ControlledVehicle.TAU_PURSUIT == control.PURSUIT_S
    assert ControlledVehicle.MAX_STEERING_ANGLE == control.MAX_STEERING_RAD
    assert Vehicle.MAX_SPEED == kinematics.MAX_SPEED_MPS
    assert Vehicle.MIN_SPEED == kinematics.MIN_SPEED_MPS


@pytest.mark.parametrize("seed", range(5))
def test_the_bicycle_model_equals_that_of_highway_env(seed: int) -> None:
    rng = np.random.default_rng(seed)
    theirs = Vehicle(None, [3.0, -2.0], heading=rng.uniform(-3, 3), speed=rng.uniform(-42, 42))
    limits = (kinematics.MIN_SPEED_MPS, kinematics.MAX_SPEED_MPS)
    x, y, heading, speed = 3.0, -2.0, theirs.heading, theirs.speed
    for tick in range(400):
        command = (rng.uniform(-8.0, 8.0), rng.uniform(-1.0, 1.0))
        theirs.crashed = tick > 350
        theirs.act({"acceleration": command[0], "steering": command[1]})
        theirs.step(0.05)
        accel, steering = clip_control(speed, *command, theirs.crashed, *limits)
        x, y, heading, speed, _ = kinematics.bicycle_step(
            x, y, heading, speed, accel, steering, Vehicle.LENGTH, 0.05
        )
        assert [x, y, speed] == pytest.approx([*theirs.position, theirs.speed], rel=0, abs=1e-12)
        assert abs(wrap_angle(heading - theirs.heading)) < 1e-12
        # Continue from equal numbers, so that differences of rounding do not add up.
        (x, y), heading, speed = theirs.position, theirs.heading, theirs.speed


def test_the_bicycle_model_stays_close_to_that_of_highway_env_for_a_minute() -> None:
    theirs = Vehicle(None, [0.0, 0.0], heading=0.4, speed=12.0)
    x, y, heading, speed = 0.0, 0.0, 0.4, 12.0
    for tick in range(1200):
        accel, steering = 2.0 * math.sin(0.1 * tick), 0.3 * math.cos(0.03 * tick)
        theirs.act({"acceleration": accel, "steering": steering})
        theirs.step(0.05)
        x, y, heading, speed, _ = kinematics.bicycle_step(
            x, y, heading, speed, accel, steering, Vehicle.LENGTH, 0.05
        )
    assert [x, y, speed] == pytest.approx([*theirs.position, theirs.speed], rel=0, abs=1e-9)


def random_road(seed: int, lanes: int = 3, cars: int = 12) -> Road:
    """Make a straight road with IDM cars at random positions, speeds and small angles."""
    rng = np.random.default_rng(seed)
    network = RoadNetwork.straight_road_network(lanes, length=400.0, speed_limit=30.0)
    road = Road(network=network, np_random=np.random.RandomState(seed), record_history=False)
    for _ in range(cars):
        lane = network.get_lane(("0", "1", int(rng.integers(lanes))))
        car = IDMVehicle(
            road,
            lane.position(rng.uniform(0.0, 400.0), rng.uniform(-1.0, 1.0)),
            heading=rng.uniform(-0.1, 0.1),
            speed=rng.uniform(0.0, 35.0),
            target_speed=rng.uniform(10.0, 40.0),
        )
        road.vehicles.append(car)
    return road


def our_acceleration(car: IDMVehicle | None, front: IDMVehicle | None) -> float:
    """Return the acceleration of cavmarl's IDM for a car of highway-env behind another car."""
    if car is None:
        return 0.0
    target_speed = min(max(car.target_speed, 0.0), car.lane.speed_limit)
    if front is None:
        return idm.idm_free(car.speed, target_speed, idm.ACCEL_MAX)
    front_speed = float(front.velocity @ car.direction)
    # highway-env also projects the car's own speed, which changes the last bit.
    distance = car.lane_distance_to(front)
    taken = idm.idm_interaction(car.speed, distance, front_speed, *IDM_DEFAULTS)
    return idm.idm_free(car.speed, target_speed, idm.ACCEL_MAX) - taken


@pytest.mark.parametrize("seed", range(20))
def test_accelerations_equal_those_of_highway_env(seed: int) -> None:
    cars = random_road(seed).vehicles
    for car in cars:
        for front in (None, *cars):
            if front is not car:
                theirs = car.acceleration(car, front)
                assert our_acceleration(car, front) == pytest.approx(theirs, rel=1e-12, abs=1e-12)


def our_mobil(car: IDMVehicle, lane: tuple[str, str, int], mandatory: bool) -> bool:
    """Return the decision of cavmarl's MOBIL with the neighbours that highway-env finds."""
    ahead, behind = car.road.neighbour_vehicles(car)
    new_ahead, new_behind = car.road.neighbour_vehicles(car, lane)
    return lane_change.mobil_accepts(
        our_acceleration(car, ahead),
        our_acceleration(car, new_ahead),
        our_acceleration(new_behind, new_ahead),
        our_acceleration(new_behind, car),
        our_acceleration(behind, car),
        our_acceleration(behind, ahead),
        mandatory,
    )


def test_lane_changes_equal_those_of_highway_env() -> None:
    decisions = []
    for seed in range(60):
        road = random_road(seed)
        for car in road.vehicles:
            for lane in road.network.side_lanes(car.lane_index):
                decisions.append(car.mobil(lane))
                assert our_mobil(car, lane, mandatory=False) == decisions[-1]
    assert 0.05 < np.mean(decisions) < 0.95


def test_lane_changes_for_a_route_equal_those_of_highway_env() -> None:
    decisions = []
    for seed in range(60):
        road = random_road(seed)
        for car in road.vehicles:
            for lane in road.network.side_lanes(car.lane_index):
                car.route = [lane]
                decisions.append(car.mobil(lane))
                assert our_mobil(car, lane, mandatory=True) == decisions[-1]
    assert 0.05 < np.mean(decisions) < 0.95


LANES = {
    "straight": StraightLane([0.0, 0.0], [300.0, 80.0], speed_limit=30.0),
    "left bend": CircularLane([0.0, 0.0], 60.0, 0.0, 2.0, clockwise=True, speed_limit=30.0),
    "right bend": CircularLane([0.0, 0.0], 60.0, 0.0, -2.0, clockwise=False, speed_limit=30.0),
}


@pytest.mark.parametrize("name", LANES)
def test_steering_and_speed_control_equal_those_of_highway_env(name: str) -> None:
    rng = np.random.default_rng(3)
    lane = LANES[name]
    network = RoadNetwork()
    network.add_lane("a", "b", lane)
    road = Road(network=network, np_random=np.random.RandomState(0), record_history=False)
    for _ in range(300):
        place = lane.position(rng.uniform(5.0, 100.0), rng.uniform(-4.0, 4.0))
        heading = rng.uniform(-math.pi, math.pi)
        car = ControlledVehicle(road, place, heading=heading, speed=rng.uniform(-3.0, 40.0))
        s, d = lane.local_coordinates(car.position)
        error = lane.heading_at(s + car.speed * control.PURSUIT_S) - car.heading
        steering = control.steering_control(car.speed, d, error, ControlledVehicle.LENGTH)
        theirs = car.steering_control(("a", "b", 0))
        assert steering == pytest.approx(theirs, rel=0, abs=1e-12)
        target = rng.uniform(0.0, 40.0)
        assert control.speed_control(car.speed, target) == car.speed_control(target)
