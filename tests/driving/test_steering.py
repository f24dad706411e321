from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.driving.kernels.motion.bicycle import bicycle_step
from cavmarl.driving.kernels.motion.highway_control import steering_control
from cavmarl.driving.kernels.motion.steering import nearest_speed, steer_to_lane, take_meta_action
from cavmarl.driving.kernels.motion.tracking import locate
from cavmarl.roads.routing import lane_grid
from tests.support.traffic import network, on_lane, plans

LEFT, IDLE, RIGHT, FASTER, SLOWER = range(5)

speeds = st.lists(st.floats(0.0, 40.0), min_size=2, max_size=9, unique=True).map(sorted)


@given(speeds, st.floats(-5.0, 50.0))
def test_nearest_speed_finds_the_nearest_target_speed(targets: list[float], speed: float) -> None:
    array = np.array(targets)
    assert nearest_speed(array, speed) == min(
        range(len(targets)), key=lambda k: (abs(targets[k] - speed), k)
    )


@given(speeds, st.floats(0.0, 40.0), st.sampled_from([FASTER, SLOWER, IDLE]))
def test_faster_and_slower_select_the_next_target_speed_of_the_list(
    targets: list[float], present: float, action: int
) -> None:
    roads = network("merge")
    row = on_lane(roads, 0, 5.0, target_speed=present)
    take_meta_action(roads.arrays, row[0], action, np.array(targets))
    before = min(range(len(targets)), key=lambda k: (abs(targets[k] - present), k))
    step = {FASTER: 1, SLOWER: -1, IDLE: 0}[action]
    after = min(max(before + step, 0), len(targets) - 1)
    assert row[0]["target_speed"] == targets[after]
    assert row[0]["target_lane"] == row[0]["lane"]


@pytest.mark.parametrize("name", ["ring", "merge", "grid4x4"])
def test_a_lane_change_selects_the_neighbour_lane_if_there_is_one(name: str) -> None:
    roads = network(name)
    targets = np.array([0.0, 10.0])
    for lane, here in enumerate(roads.lanes):
        for action, side in ((LEFT, "left"), (RIGHT, "right")):
            row = on_lane(roads, lane, 0.5 * float(here["length_m"]))
            take_meta_action(roads.arrays, row[0], action, targets)
            expected = here[side] if here[side] >= 0 else lane
            assert row[0]["target_lane"] == expected


def test_the_controller_steers_straight_in_the_middle_of_a_lane_and_towards_it_elsewhere() -> None:
    roads = network("merge")
    lane = roads.lane_ids.index("main_in_0")
    row = on_lane(roads, lane, 50.0, speed=10.0)
    assert steer_to_lane(roads.arrays, plans("merge"), row[0], lane, 5.0) == pytest.approx(
        0.0, abs=1e-9
    )
    for d, sign in ((0.5, -1.0), (-0.5, 1.0)):
        aside = on_lane(roads, lane, 50.0, speed=10.0, d=d)
        assert (
            math.copysign(1.0, steer_to_lane(roads.arrays, plans("merge"), aside[0], lane, 5.0))
            == sign
        )
    left = steer_to_lane(roads.arrays, plans("merge"), row[0], int(roads.lanes[lane]["left"]), 5.0)
    assert left > 0.0


def test_a_target_lane_that_is_not_a_neighbour_is_treated_as_the_own_lane() -> None:
    roads = network("merge")
    lane = roads.lane_ids.index("main_in_0")
    far = roads.lane_ids.index("main_out_1")
    row = on_lane(roads, lane, 50.0, speed=10.0, d=0.4)
    own, other, none = (
        steer_to_lane(roads.arrays, plans("merge"), row[0], target, 5.0)
        for target in (lane, far, -1)
    )
    assert own == other == none != 0.0


@given(
    st.sampled_from(["ring", "merge"]),
    st.floats(3.0, 14.0),
    st.floats(-1.0, 1.0),
    st.floats(-0.3, 0.3),
)
def test_the_controller_brings_a_car_to_the_middle_and_keeps_it_there(
    name: str, speed: float, d: float, askew: float
) -> None:
    roads, table = network(name), plans(name)
    grid = lane_grid(roads)
    lane = roads.lane_ids.index({"ring": "e0_0", "merge": "main_in_0"}[name])
    row = on_lane(roads, lane, 3.0, speed=speed, d=d)
    way = np.nan_to_num(table[:, lane]["to_go"], posinf=0.0)
    row["goal"] = int(way.argmax())
    row["heading"] += askew
    car = row[0]
    offsets = []
    for _ in range(round(60.0 / speed / 0.05)):
        wheels = steer_to_lane(roads.arrays, table, car, int(car["lane"]), 5.0)
        assert abs(wheels) <= math.pi / 3.0
        car["x"], car["y"], car["heading"], _, _ = bicycle_step(
            car["x"], car["y"], car["heading"], speed, 0.0, wheels, 5.0, 0.05
        )
        assert locate(roads.arrays, table, grid, car) == 0
        offsets.append(abs(float(car["d"])))
    assert max(offsets[len(offsets) // 2 :]) < 0.3


@pytest.mark.parametrize(
    ("speed", "d", "askew", "straightens"),
    [
        (0.3, -0.5, 0.6, True),  # otherwise the front would cross the far side of the lane
        (0.3, -0.5, 0.4, False),  # the car has room to reach the middle
        (0.3, -1.5, 0.5, False),
        (8.0, -0.5, 0.6, True),  # at this speed, the controller straightens the car anyway
    ],
)
def test_a_slow_car_that_changes_lanes_keeps_its_front_on_the_lane(
    speed: float, d: float, askew: float, straightens: bool
) -> None:
    roads = network("merge")
    lane = roads.lane_ids.index("main_in_0")
    row = on_lane(roads, lane, 50.0, speed=speed, d=d)
    row["heading"] += askew
    steering = steer_to_lane(roads.arrays, plans("merge"), row[0], lane, 5.0)
    assert (steering < 0.0) == straightens


@pytest.mark.parametrize(("place", "as_fast"), [(5.0, True), (50.0, False)])
def test_a_slow_car_right_behind_a_junction_steers_as_at_turning_speed(
    place: float, as_fast: bool
) -> None:
    # The car has cut the corner. If it steered more, it would swing out over the other direction.
    roads = network("merge")
    lane = roads.lane_ids.index("main_in_0")
    row = on_lane(roads, lane, place, speed=1.0, d=-0.2)
    steering = steer_to_lane(roads.arrays, plans("merge"), row[0], lane, 5.0)
    as_it_goes, as_in_turns = (steering_control(mps, -0.2, 0.0, 5.0) for mps in (1.0, 3.5))
    assert as_in_turns < 0.9 * as_it_goes
    assert steering == pytest.approx(as_in_turns if as_fast else as_it_goes)
