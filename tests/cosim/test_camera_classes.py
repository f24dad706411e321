"""A camera distinguishes pedestrians from vehicles."""

from __future__ import annotations

import math

import numpy as np
import pytest

import cavmarl
from cavmarl.core.errors import ConfigError
from cavmarl.core.records.codes import CLASS_PEDESTRIAN
from cavmarl.cosim.followers.follower_client import sight_of
from cavmarl.cosim.followers.follower_snapshots import SnapshotTime, take_snapshot, welcome_to
from cavmarl.cosim.stack.camera_classes import LidarCamera
from cavmarl.cosim.stack.hd_map import HdMap
from cavmarl.cosim.stack.route_planning import LaneRoute
from cavmarl.cosim.stack.stack import CAMERA_RIG, sensor_of
from cavmarl.cosim.stack.stack_types import EgoPose, Mission, Obstacle


def test_a_camera_distinguishes_a_pedestrian_from_a_van() -> None:
    """Check the class of each detected object against the true object at its place.

    A group of lidar echoes gets the most frequent class among the camera pixels onto which its
    echoes fall. Pixels have exact classes and are 0.2 m wide at 16 m; echoes have errors of 2 cm.
    The test skips detections while the pedestrian is close to the van, because objects less than
    0.8 m apart form one group.
    """
    env = cavmarl.parallel_env(
        "grid4x4",
        agents=1,
        overrides={
            "rig": CAMERA_RIG,
            "scenario.name": "pedestrian_crossing",
            "scenario.params": {"occluded": True},
            "population.budget": None,
        },
    )
    env.reset(seed=0)
    sensors = [sensor_of(v.name, v.settings) for v in welcome_to(env, ["car_0"], 0).sensors]
    stage = LidarCamera(sensors, HdMap(env.network))
    kinds: dict[str, int] = {}
    wrong = []
    for step in range(60):
        if not env.agents:
            break
        tick = int(env.worlds.ticks()[0])
        sight = sight_of(*take_snapshot(env, [0], SnapshotTime(step, 0, tick, False)))
        rows = env.simulation.vehicles()
        own = rows[rows["agent"] == 0][0]
        pose = EgoPose(*(float(own[name]) for name in ("x", "y", "heading", "speed")))
        others = rows[rows["agent"] != 0]
        on_foot = env.simulation.types["vclass"][others["vtype"]] == CLASS_PEDESTRIAN
        for seen in stage.perceive(sight.sensors["car_0"], pose, sight.snapshot.time_s):
            off = np.hypot(others["x"] - seen.x_m, others["y"] - seen.y_m)
            walker, van = off[on_foot].min(initial=99.0), off[~on_foot].min(initial=99.0)
            if seen.kind == "unknown" or (walker > 0.6) == (van > 3.0 or walker < 3.0):
                continue  # outside of the picture, or pedestrian and van are too close
            if seen.kind != ("pedestrian" if walker < 0.6 else "vehicle"):
                wrong.append(seen)
            kinds[seen.kind] = kinds.get(seen.kind, 0) + 1
        env.step(env.suggest_actions())
    assert not wrong
    assert kinds.get("pedestrian", 0) >= 3, kinds
    assert kinds.get("vehicle", 0) >= 3, kinds


def test_a_stack_without_a_camera_is_refused() -> None:
    with pytest.raises(ConfigError, match="no semantic_camera among the sensors"):
        LidarCamera([], None)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def grid() -> HdMap:
    from cavmarl.config.registry import load_config
    from cavmarl.engine.world_setup import load_roads

    return HdMap(load_roads(*load_config("grid4x4")))


def test_the_stack_brakes_for_a_pedestrian_who_walks_onto_its_path(grid: HdMap) -> None:
    lanes = grid.network.lanes
    lane = int(np.flatnonzero(~lanes["internal"] & (lanes["length_m"] > 60.0))[0])
    link = int(lanes["first_link"][lane])
    goal = int(lanes["edge"][grid.network.links["to_lane"][link]])
    (x, y), *_ = grid.polyline(lane, 10.0).tolist()
    heading = grid.on_lane(lane, x, y).heading_rad
    pose = EgoPose(x, y, heading, 8.0)
    cos, sin = math.cos(heading), math.sin(heading)

    def reason(kind: str, aside_m: float, walks_mps: float) -> str:
        place = (x + 20.0 * cos - aside_m * sin, y + 20.0 * sin + aside_m * cos)
        one = Obstacle(*place, heading, 0.5, 0.5, -walks_mps * sin, walks_mps * cos, kind)
        plan = LaneRoute(grid).plan(pose, [one], None, Mission(goal, "passenger", 5.0, 1.8))
        return plan.reason

    assert reason("pedestrian", -4.0, 1.4) == "pedestrian"  # steps onto the road
    assert reason("pedestrian", -4.0, -1.4) != "pedestrian"  # walks away
    assert reason("pedestrian", 0.0, 0.0) == "pedestrian"
    assert reason("unknown", -4.0, 1.4) != "gap"
