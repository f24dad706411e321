"""Each stage of the reference stack by itself."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import cavmarl
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.core.math.geometry import wrap_angle
from cavmarl.core.records.codes import SIGNAL_GREEN_MAJOR, SIGNAL_RED
from cavmarl.cosim.followers.follower_client import sight_of
from cavmarl.cosim.followers.follower_snapshots import SnapshotTime, take_snapshot, welcome_to
from cavmarl.cosim.stack.hd_map import HdMap, OnLane
from cavmarl.cosim.stack.localisation import GnssInertial
from cavmarl.cosim.stack.perception import LidarObjects
from cavmarl.cosim.stack.route_planning import LaneRoute
from cavmarl.cosim.stack.stack import (
    GAINS,
    REFERENCE_RIG,
    STAGES,
    PurePursuit,
    Stack,
    StackConfig,
    sensor_of,
    vehicle_of,
)
from cavmarl.cosim.stack.stack_types import (
    EgoPose,
    Mission,
    Obstacle,
    StackMount,
    StackSensor,
    Trajectory,
)
from cavmarl.driving.kernels.motion.bicycle import bicycle_step
from cavmarl.engine.world_setup import load_roads

TICK_S = 0.05
RIG = {name: keys for name, keys in REFERENCE_RIG.items() if name != "lidar"}


@dataclass
class Scan:
    values: NDArray[Any]

    @property
    def stamps_s(self) -> NDArray[np.float64]:
        return np.zeros(1)

    @property
    def lost(self) -> NDArray[np.bool_]:
        return np.zeros(1, dtype=np.bool_)


@pytest.fixture(scope="module")
def grid() -> HdMap:
    return HdMap(load_roads(*load_config("grid4x4")))


@pytest.mark.parametrize(
    ("vclass", "length_m", "bound_m"), [("passenger", 5.0, 0.1), ("truck", 7.1, 0.1)]
)
def test_the_control_stage_follows_a_bend_of_50_m_at_8_mps(
    vclass: str, length_m: float, bound_m: float
) -> None:
    radius = 50.0
    angles = np.linspace(-0.5 * math.pi, 1.5 * math.pi, 721)
    ring = Trajectory(radius * np.stack([np.cos(angles), np.sin(angles)], axis=1), 0.0)
    mission = Mission(0, vclass, length_m, 2.4)
    control = PurePursuit(TICK_S)
    x, y, heading, speed = (
        0.0,
        -radius - 0.5,
        0.0,
        8.0,
    )  # the vehicle starts half a metre outside of the circle
    off = []
    for _ in range(600):
        driven = control.control(EgoPose(x, y, heading, speed), ring, mission)
        assert driven.accel_mps2 == 0.0
        x, y, heading, speed, _ = bicycle_step(
            x, y, heading, speed, 0.0, driven.steering_rad, length_m, TICK_S
        )
        off.append(abs(math.hypot(x, y) - radius))
    assert max(off[100:]) < bound_m
    assert max(off) < 0.6


def test_control_gains_depend_on_the_type_of_the_vehicle() -> None:
    straight = Trajectory(np.array([[0.0, 0.0], [100.0, 0.0]]), -100.0)
    pose = EgoPose(0.0, 1.0, 0.0, 10.0)
    for vclass, gains in GAINS.items():
        driven = PurePursuit(TICK_S).control(pose, straight, Mission(0, vclass, 8.0, 2.5))
        assert driven.accel_mps2 == -gains.brake_mps2
        assert -gains.steering_radps * TICK_S <= driven.steering_rad < 0.0


class ReversedMap(HdMap):
    """A map with reversed lane directions."""

    def near(self, x_m: float, y_m: float, within_m: float) -> list[OnLane]:
        found = super().near(x_m, y_m, within_m)
        return [lane._replace(heading_rad=wrap_angle(lane.heading_rad + math.pi)) for lane in found]


def localise(seed: int, steps: int, *, is_reversed: bool = False) -> list[float]:
    """Return the position error of the GNSS and inertial filter after each step, in m."""
    env = cavmarl.parallel_env(
        "grid4x4", agents=2, background=0, overrides={"clock.ctrl_dt_s": TICK_S, "rig": RIG}
    )
    env.reset(seed=seed)
    welcome = welcome_to(env, ["car_0"], 0)
    sensors = [sensor_of(view.name, view.settings) for view in welcome.sensors]
    vehicle = vehicle_of(HdMap(env.network), sensors, TICK_S)
    assert vehicle.geodesy is not None
    hd_map = ReversedMap(env.network) if is_reversed else vehicle.hd_map
    stage = GnssInertial(sensors, vehicle.geodesy, hd_map, TICK_S)
    off = []
    for step in range(steps):
        sight = sight_of(*take_snapshot(env, [0], SnapshotTime(step, 0, step, False)))
        view = sight.snapshot.vehicles["car_0"]
        mission = Mission(0, view.vclass, view.length_m, view.width_m)
        pose = stage.locate(sight.sensors["car_0"], mission, sight.snapshot.time_s)
        assert pose is not None  # the reset gives the first fix
        rows = env.simulation.vehicles()
        row = rows[rows["agent"] == 0][0]
        off.append(math.hypot(pose.x_m - row["x"], pose.y_m - row["y"]))
        if step > 0.75 * steps:
            assert abs(wrap_angle(pose.heading_rad - row["heading"])) < 0.1
            assert abs(pose.speed_mps - row["speed"]) < 0.5
        env.step(env.suggest_actions())
    return off


@pytest.mark.parametrize("seed", range(4))
def test_localisation_converges_within_5_s(seed: int) -> None:
    off = localise(seed, 160)
    assert max(off[100:]) < 1.2
    assert np.mean(off[100:]) < 0.7


def test_localisation_corrects_a_reversed_heading() -> None:
    off = localise(1, 240, is_reversed=True)
    assert max(off) > 3.0
    assert max(off[200:]) < 1.2


def test_the_stack_starts_from_a_given_pose(grid: HdMap) -> None:
    env = cavmarl.parallel_env("grid4x4", agents=1, background=0, overrides={"rig": RIG})
    sensors = [sensor_of(v.name, v.settings) for v in welcome_to(env, [], 0).sensors]
    stack = Stack(vehicle_of(grid, sensors, TICK_S))
    mission = Mission(0, "passenger", 5.0, 2.0)
    assert stack.drive({}, None, mission, 0.0) == (-1.0, 0.0)
    assert stack.pose is None
    told = EgoPose(12.0, 34.0, 0.5, 0.0)
    stack.reset_pose(told)
    stack.drive({}, None, mission, 0.05)
    assert stack.pose == pytest.approx(told)
    assert stack.times.steps == 2
    assert set(stack.times.wall_s) == set(STAGES)


def lane_of(grid: HdMap, length_m: float) -> int:
    """Return a lane with at least this length that has a link at its end."""
    lanes = grid.network.lanes
    for lane, row in enumerate(lanes):
        if row["internal"] or row["length_m"] < length_m or row["num_links"] == 0:
            continue
        return lane
    raise AssertionError("no such lane")


def goal_after(grid: HdMap, lane: int) -> tuple[int, int]:
    """Return the first link of a lane, and the edge to which it leads."""
    link = int(grid.network.lanes["first_link"][lane])
    return link, int(grid.network.lanes["edge"][grid.network.links["to_lane"][link]])


def pose_on(grid: HdMap, lane: int, s_m: float, speed_mps: float) -> EgoPose:
    (x, y), *_ = grid.polyline(lane, s_m).tolist()
    place = grid.on_lane(lane, x, y)
    return EgoPose(x, y, place.heading_rad, speed_mps)


def test_the_stack_stops_at_a_red_signal(grid: HdMap) -> None:
    lane = lane_of(grid, 60.0)
    link, goal = goal_after(grid, lane)
    signals = np.full(len(grid.network.links), SIGNAL_GREEN_MAJOR, dtype=np.uint8)
    pose = pose_on(grid, lane, float(grid.network.lanes["length_m"][lane]) - 20.0, 10.0)
    mission = Mission(goal, "passenger", 5.0, 2.0)
    green = LaneRoute(grid).plan(pose, [], signals, mission)
    assert green.reason == "free"
    signals[link] = SIGNAL_RED
    red = LaneRoute(grid).plan(pose, [], signals, mission)
    assert red.reason == "stop_line"
    assert red.accel_mps2 < green.accel_mps2 - 1.0


def test_the_stack_keeps_a_gap_to_objects_on_its_path_only(grid: HdMap) -> None:
    lane = lane_of(grid, 60.0)
    _, goal = goal_after(grid, lane)
    mission = Mission(goal, "passenger", 5.0, 2.0)
    pose = pose_on(grid, lane, 10.0, 10.0)
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)

    def plan(ahead_m: float, aside_m: float, speed_mps: float) -> Trajectory:
        obstacle = Obstacle(
            pose.x_m + ahead_m * cos - aside_m * sin,
            pose.y_m + ahead_m * sin + aside_m * cos,
            pose.heading_rad, 5.0, 2.0, speed_mps * cos, speed_mps * sin,
        )  # fmt: skip
        return LaneRoute(grid).plan(pose, [obstacle], None, mission)

    near, far, moving = plan(15.0, 0.0, 0.0), plan(30.0, 0.0, 0.0), plan(15.0, 0.0, 10.0)
    assert near.reason == "gap"
    assert near.accel_mps2 < far.accel_mps2 < moving.accel_mps2
    for aside_m in (3.5, -3.5):
        assert plan(15.0, aside_m, 0.0).reason != "gap"
    assert plan(-15.0, 0.0, 0.0).reason != "gap"


def test_the_stack_yields_to_a_vehicle_with_the_right_of_way(grid: HdMap) -> None:
    network = grid.network
    for row in network.links:
        conflicts = network.conflicts[row["first_conflict"] :][: row["num_conflicts"]]
        foes = conflicts["foe"][conflicts["must_yield"]]
        lane = int(row["from_lane"])
        before = network.links["from_lane"][foes]
        if len(foes) and (before != lane).all() and network.lanes["length_m"][lane] > 30.0:
            break
    goal = int(network.lanes["edge"][row["to_lane"]])
    mission = Mission(goal, "passenger", 5.0, 2.0)
    pose = pose_on(grid, lane, float(network.lanes["length_m"][lane]) - 12.0, 6.0)
    theirs = int(before[0])
    foe = pose_on(grid, theirs, float(network.lanes["length_m"][theirs]) - 15.0, 0.0)
    cos, sin = math.cos(foe.heading_rad), math.sin(foe.heading_rad)

    def plan(speed_mps: float) -> Trajectory:
        coming = Obstacle(
            foe.x_m, foe.y_m, foe.heading_rad, 4.0, 2.0, speed_mps * cos, speed_mps * sin
        )
        return LaneRoute(grid).plan(pose, [coming], None, mission)

    assert plan(8.0).reason == "yield"
    assert plan(0.0).reason != "yield"


def scan_of(
    pose: EgoPose, box: tuple[float, float, float, float], rays: int
) -> NDArray[np.float64]:
    """Scan a box (x, y, half length, half width) with a lidar at the vehicle's centre."""
    ranges = np.full((1, 1, rays), 60.0)
    for k in [*range(rays // 12), *range(11 * rays // 12, rays)]:  # the box is ahead
        azimuth = pose.heading_rad + 2.0 * math.pi * k / rays
        for r in np.arange(10.0, 25.0, 0.05):
            x = pose.x_m + r * math.cos(azimuth) - box[0]
            y = pose.y_m + r * math.sin(azimuth) - box[1]
            cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
            if abs(x * cos + y * sin) <= box[2] and abs(y * cos - x * sin) <= box[3]:
                ranges[0, 0, k] = r
                break
    return ranges


def test_echoes_become_an_object_with_a_velocity(grid: HdMap) -> None:
    lane = lane_of(grid, 60.0)
    pose = pose_on(grid, lane, 10.0, 0.0)
    settings = {"fov_deg": 360.0, "range_m": 60.0}
    stage = LidarObjects([StackSensor("roof", "lidar", StackMount(0.0, 0.0, 0.0), settings)], grid)
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    for step in range(8):
        ahead = 15.0 + 0.5 * step  # 5 m/s at ten scans per second
        box = (pose.x_m + ahead * cos, pose.y_m + ahead * sin, 2.5, 1.0)
        found = stage.perceive({"roof": Scan(scan_of(pose, box, 360))}, pose, 0.1 * step)
        assert stage.perceive({}, pose, 0.1 * step + 0.05) == found
    (seen,) = found
    rear = math.hypot(seen.x_m - pose.x_m, seen.y_m - pose.y_m) - 0.5 * seen.length_m
    assert rear == pytest.approx(ahead - 2.5, abs=0.3)
    assert seen.width_m == pytest.approx(2.0, abs=0.4)
    assert seen.vx_mps * cos + seen.vy_mps * sin == pytest.approx(5.0, abs=0.7)
    nothing = np.full((1, 1, 360), 60.0)
    assert stage.perceive({"roof": Scan(nothing)}, pose, 2.0) in ([], found)


def test_a_lidar_with_one_ray_detects_an_object_ahead(grid: HdMap) -> None:
    pose = pose_on(grid, lane_of(grid, 60.0), 10.0, 0.0)
    settings = {"fov_deg": 90.0, "range_m": 60.0}
    stage = LidarObjects([StackSensor("nose", "lidar", StackMount(0.0, 0.0, 0.0), settings)], grid)
    (seen,) = stage.perceive({"nose": Scan(np.full((1, 1, 1), 20.0))}, pose, 0.0)
    assert seen.x_m == pytest.approx(pose.x_m + 20.0 * math.cos(pose.heading_rad))
    assert seen.y_m == pytest.approx(pose.y_m + 20.0 * math.sin(pose.heading_rad))


def test_an_unknown_name_of_a_stage_is_refused() -> None:
    with pytest.raises(
        ConfigError, match="perception = 'radar': must be lidar or lidar_camera or blind"
    ):
        StackConfig(perception="radar")
    assert StackConfig(perception="blind").planning == "lane_route"


def test_a_stack_without_gnss_is_refused(grid: HdMap) -> None:
    with pytest.raises(ConfigError, match="there is no gnss among the sensors"):
        Stack(vehicle_of(grid, [], TICK_S))
