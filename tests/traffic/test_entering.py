"""Lane, position and speed of departures: SUMO's attribute values, and gaps to other vehicles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.math.rng import world_key
from cavmarl.core.records import codes
from cavmarl.core.records.arrays import Scratch, TripTables
from cavmarl.driving.kernels.lanes.lane_index import VIEW_M, index_lanes
from cavmarl.driving.kernels.models.following import speed_behind
from cavmarl.driving.vehicle_types import generated_types
from cavmarl.roads.routing import PLAN as _PLAN
from cavmarl.roads.routing import make_plans
from cavmarl.traffic.departure_queue import DEPARTURE
from cavmarl.traffic.kernels.entering import (
    crowd,
    entry_lane,
    entry_place,
    entry_speed,
    follower_brakes,
    speed_at,
)
from tests.support.traffic import network, on_lane, scratch, travel, travel_by

ROADS = network("merge")
PLAN = make_plans(ROADS, [ROADS.edge_ids.index("main_out")])
TRAVEL = travel_by(PLAN)
KIND = generated_types()[0]
KEY = world_key(1, 0, 0)
# Three lanes; the rightmost lane ends, so vehicles on it must change lanes.
WEAVE = [ROADS.lane_ids.index(f"weave_{k}") for k in range(3)]
MAIN = [ROADS.lane_ids.index(f"main_in_{k}") for k in range(2)]
LENGTH = float(ROADS.lanes["length_m"][MAIN[0]])
LIMIT = float(ROADS.lanes["speed_mps"][MAIN[0]])


def departure(lane: int = MAIN[0], **fields: Any) -> np.void:
    """Return a waiting departure; `fields`: further fields of its record."""
    row = np.zeros(1, DEPARTURE)
    row["id"], row["agent"], row["lane"], row["speed_factor"] = 50, -1, lane, 1.0
    for field, value in fields.items():
        row[field] = value
    return row[0]


def traffic(*places: tuple[int, float, float]) -> tuple[NDArray[np.void], Scratch]:
    """Return cars at (lane, s, speed) with ids from 0 on, and their index by lane."""
    rows = [
        on_lane(ROADS, lane, s, TRAVEL, speed=speed, id=k)
        for k, (lane, s, speed) in enumerate(places)
    ]
    cars = np.concatenate(rows) if rows else on_lane(ROADS, MAIN[0], 0.0, TRAVEL)[:0]
    room = scratch(ROADS, max(len(cars), 1))
    index_lanes(ROADS.arrays, TRAVEL, cars, len(cars), room)
    return cars, room


def lane_of(
    code: int,
    room: Scratch,
    lane: int = WEAVE[0],
    vehicle: int = 50,
    *,
    taken: Sequence[int] = (),
    travel: TripTables = TRAVEL,
) -> int:
    waiting = departure(lane, lane_code=code, id=vehicle)
    edge = ROADS.edges[ROADS.lanes["edge"][lane]]
    lanes = range(int(edge["first_lane"]), int(edge["first_lane"] + edge["num_lanes"]))
    ranks = np.array([crowd(room, each, 0.0, VIEW_M) for each in lanes])
    flags = np.isin(np.arange(len(ROADS.lanes)), taken)
    return entry_lane(ROADS.arrays, travel, KEY, waiting, ranks, flags)


def test_one_departure_per_tick_enters_a_given_lane() -> None:
    _, room = traffic()
    for lane in WEAVE:
        assert lane_of(codes.LANE_GIVEN, room, lane) == lane
    assert lane_of(codes.LANE_GIVEN, room, WEAVE[1], taken=[WEAVE[1]]) == -1


def test_lane_first_is_the_rightmost_lane() -> None:
    _, room = traffic()
    assert lane_of(codes.LANE_FIRST, room, WEAVE[2]) == WEAVE[0]
    assert lane_of(codes.LANE_FIRST, room, WEAVE[2], taken=[WEAVE[0]]) == -1


def test_random_lanes_are_equally_likely_and_repeatable() -> None:
    _, room = traffic()
    picked = [lane_of(codes.LANE_RANDOM, room, vehicle=k) for k in range(600)]
    assert picked == [lane_of(codes.LANE_RANDOM, room, vehicle=k) for k in range(600)]
    for lane in WEAVE:
        assert 150 < picked.count(lane) < 250
    again = [lane_of(codes.LANE_RANDOM, room, vehicle=k, taken=[WEAVE[2]]) for k in range(600)]
    assert again == [-1 if lane == WEAVE[2] else lane for lane in picked]


@pytest.mark.parametrize("code", [codes.LANE_FREE, codes.LANE_ALLOWED])
def test_lane_free_is_the_emptiest_lane_or_the_rightmost_of_equally_empty_lanes(code: int) -> None:
    _, room = traffic((WEAVE[0], 20.0, 5.0), (WEAVE[0], 60.0, 5.0), (WEAVE[1], 40.0, 5.0))
    assert lane_of(code, room) == WEAVE[2]
    _, room = traffic((WEAVE[0], 20.0, 5.0))
    assert lane_of(code, room) == WEAVE[1]
    assert lane_of(code, room, taken=[WEAVE[1]]) == WEAVE[2]


@pytest.mark.parametrize(("way_m", "counts"), [(2900.0, False), (3100.0, True)])
def test_lane_best_has_no_preference_among_lanes_that_serve_the_route_for_3_km(
    way_m: float, counts: bool
) -> None:
    plan = PLAN.copy()
    plan[0]["room"][WEAVE] = way_m, 5000.0, 4000.0
    _, room = traffic()
    lane = lane_of(codes.LANE_BEST, room, travel=travel_by(plan))
    assert lane == (WEAVE[0] if counts else WEAVE[1])


def test_lane_best_is_the_emptiest_lane_that_needs_no_lane_change() -> None:
    assert PLAN[0][WEAVE[0]]["changes"] > 0
    _, room = traffic((WEAVE[1], 20.0, 5.0))
    assert lane_of(codes.LANE_BEST, room) == WEAVE[2]
    taken = WEAVE[1:]
    assert lane_of(codes.LANE_BEST, room, taken=taken) == -1, (
        "the departure does not wait for one of these lanes"
    )


def test_no_departure_enters_a_lane_without_a_route_to_its_goal() -> None:
    nowhere = travel_by(make_plans(ROADS, [ROADS.edge_ids.index("ramp")]))
    _, room = traffic()
    for code in (codes.LANE_FIRST, codes.LANE_RANDOM, codes.LANE_FREE, codes.LANE_BEST):
        assert lane_of(code, room, travel=nowhere) == -1


def place(room: Scratch, tick: int = 0, **fields: Any) -> float:
    waiting = departure(**fields)
    return entry_place(ROADS.arrays, TRAVEL, KEY, waiting, KIND, MAIN[0], tick, room)


def test_a_given_position_is_the_front_bumper_counted_from_either_end() -> None:
    _, room = traffic()
    assert place(room, pos_code=codes.POS_GIVEN, pos=40.0) == 37.5
    assert place(room, pos_code=codes.POS_GIVEN, pos=-40.0) == pytest.approx(LENGTH - 42.5)
    assert place(room, pos_code=codes.POS_GIVEN, pos=1.0) == 2.5, "the rear is not on the lane"
    assert place(room, pos_code=codes.POS_GIVEN, pos=LENGTH) == pytest.approx(LENGTH - 3.5)


def test_no_vehicle_enters_with_its_front_over_the_line_even_if_it_is_longer_than_the_lane() -> (
    None
):
    _, room = traffic()
    bus = generated_types().copy()[0]
    bus["length"] = LENGTH + 5.0
    for code in (codes.POS_GIVEN, codes.POS_BASE, codes.POS_LAST, codes.POS_RANDOM):
        car = departure(pos_code=code, pos=LENGTH)
        s = entry_place(ROADS.arrays, TRAVEL, KEY, car, bus, MAIN[0], 0, room)
        assert s + 0.5 * bus["length"] == pytest.approx(LENGTH - 1.0)


def test_position_base_puts_the_rear_at_the_start() -> None:
    _, room = traffic((MAIN[0], 100.0, 5.0))
    assert place(room, pos_code=codes.POS_BASE) == 2.5


@pytest.mark.parametrize("wanted_mps", [0.0, 5.0, 10.0])
def test_position_last_leaves_the_gap_that_is_needed_to_stop_behind_the_last_vehicle(
    wanted_mps: float,
) -> None:
    _, room = traffic((MAIN[0], 100.0, 6.0), (MAIN[0], 80.0, 3.0))
    words = {"pos_code": codes.POS_LAST, "speed_code": codes.SPEED_GIVEN, "speed": wanted_mps}
    decel = float(KIND["decel"])
    gap = wanted_mps * KIND["tau"] + (wanted_mps**2 - 3.0**2) / (2.0 * decel)
    expected = 80.0 - 2.5 - KIND["min_gap"] - max(gap, 0.0) - 2.5
    assert place(room, **words) == pytest.approx(expected)
    _, room = traffic((MAIN[0], 60.0, 0.0))
    words["speed"] = LIMIT
    assert place(room, **words) == 2.5, "the departure does not wait at the start of the lane"


def test_position_last_on_an_empty_lane_is_before_the_line() -> None:
    """A standing vehicle enters at the line, a fast one where it can still stop before the line."""
    _, room = traffic()
    words = {"pos_code": codes.POS_LAST, "speed_code": codes.SPEED_GIVEN}
    assert place(room, **words, speed=0.0) == pytest.approx(LENGTH - 3.5)
    assert place(room, **words, speed=LIMIT) < LENGTH - 3.5


def test_a_departure_at_position_last_waits_until_its_speed_is_safe() -> None:
    _, room = traffic((MAIN[0], 50.0, 3.0))
    slower = {"speed_code": codes.SPEED_MAX}
    assert 0.0 < speed(room, **slower) < LIMIT
    assert speed(room, **slower, pos_code=codes.POS_LAST) == -1.0


@pytest.mark.parametrize("code", [codes.POS_RANDOM, codes.POS_FREE, codes.POS_RANDOM_FREE])
def test_random_positions_cover_the_lane_and_differ_between_ticks(code: int) -> None:
    _, room = traffic()
    found = np.array([place(room, tick, pos_code=code) for tick in range(400)])
    assert (found >= 2.5).all()
    assert (found <= LENGTH - 2.5).all()
    counts, _ = np.histogram(found, bins=4, range=(0.0, LENGTH))
    assert counts.min() > 70
    np.testing.assert_array_equal(found, [place(room, tick, pos_code=code) for tick in range(400)])


def speed(
    room: Scratch,
    s: float = 20.0,
    vehicle: int = 50,
    cars: NDArray[np.void] | None = None,
    **fields: Any,
) -> float:
    waiting = departure(id=vehicle, **fields)
    rows = traffic()[0] if cars is None else cars
    return entry_speed(ROADS.arrays, TRAVEL, rows, KEY, waiting, KIND, MAIN[0], s, room)


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_each_departure_speed_has_its_value_on_an_empty_lane(factor: float) -> None:
    _, room = traffic()
    wanted = {"speed_factor": factor}
    assert speed(room, speed_code=codes.SPEED_GIVEN, speed=5.0, **wanted) == 5.0
    for code in (codes.SPEED_MAX, codes.SPEED_DESIRED, codes.SPEED_LAST):
        assert speed(room, speed_code=code, **wanted) == pytest.approx(factor * LIMIT)
    for code in (codes.SPEED_LIMIT, codes.SPEED_AVERAGE):
        limit = speed(room, speed_code=code, **wanted)
        assert limit == pytest.approx(min(factor, 1.0) * LIMIT)
    drawn = np.array(
        [speed(room, vehicle=k, speed_code=codes.SPEED_RANDOM, **wanted) for k in range(400)]
    )
    assert 0.0 <= drawn.min() < 0.05 * LIMIT
    assert 0.95 * factor * LIMIT < drawn.max() < factor * LIMIT
    assert drawn.mean() == pytest.approx(0.5 * factor * LIMIT, rel=0.1)


def test_speed_last_is_the_speed_of_the_last_vehicle_and_speed_average_is_the_mean() -> None:
    _, room = traffic((MAIN[0], 120.0, 6.0), (MAIN[0], 150.0, 10.0))
    assert speed(room, speed_code=codes.SPEED_LAST) == 6.0
    assert speed(room, speed_code=codes.SPEED_AVERAGE) == 8.0


@pytest.mark.parametrize("code", [codes.SPEED_DESIRED, codes.SPEED_LIMIT, codes.SPEED_AVERAGE])
def test_departures_with_speed_desired_limit_or_average_wait_for_their_speed(code: int) -> None:
    _, room = traffic((MAIN[0], 50.0, 3.0), (MAIN[0], 60.0, 2.0 * LIMIT))
    assert 0.0 < speed(room, speed_code=codes.SPEED_MAX) < LIMIT
    assert speed(room, speed_code=code) == -1.0


def test_a_leader_reduces_the_speed_but_a_departure_with_a_given_speed_waits() -> None:
    _, room = traffic((MAIN[0], 50.0, 3.0))
    safe = speed_behind(KIND, 25.0, 3.0, KIND["decel"])
    assert 3.0 < safe < LIMIT
    assert speed(room, speed_code=codes.SPEED_MAX) == pytest.approx(safe)
    assert speed(room, speed_code=codes.SPEED_GIVEN, speed=0.9 * safe) == 0.9 * safe
    assert speed(room, speed_code=codes.SPEED_GIVEN, speed=1.1 * safe) == -1.0
    assert speed(room, s=44.5, speed_code=codes.SPEED_MAX) == -1.0, (
        "a departure enters without room"
    )


def test_a_vehicle_on_the_next_lane_is_a_leader() -> None:
    # The next lane is inside the junction.
    beyond = int(PLAN[0][MAIN[0]]["next"])
    _, room = traffic((beyond, 0.0, 0.0))
    near = speed(room, s=LENGTH - 12.0, speed_code=codes.SPEED_MAX)
    assert near == pytest.approx(speed_behind(KIND, 7.0, 0.0, KIND["decel"]))


@pytest.mark.parametrize(
    ("askew", "driver", "minds"),
    [(-0.47, codes.DRIVER_AGENT, True), (0.0, codes.DRIVER_AGENT, False),
     (-0.47, codes.DRIVER_BACKGROUND, False)],
)  # fmt: skip
def test_a_steered_car_on_the_adjacent_lane_is_a_leader_if_its_rear_is_on_the_lane(
    askew: float, driver: int, minds: bool
) -> None:
    # The car has nearly finished its change to the left; its rear is over the departure's lane.
    cars, _ = traffic((MAIN[1], 50.0, 2.0))
    cars["driver"], cars["d"] = driver, -0.3
    cars["heading"] -= askew
    room = scratch(ROADS, 1)
    index_lanes(ROADS.arrays, TRAVEL, cars, 1, room)
    safe = speed_behind(KIND, 15.0, 2.0, KIND["decel"])
    found = speed(room, s=30.0, cars=cars, speed_code=codes.SPEED_MAX)
    assert found == pytest.approx(safe if minds else LIMIT)
    near = speed(room, s=44.5, cars=cars, speed_code=codes.SPEED_MAX)
    assert (near == -1.0) == minds


def test_a_vehicle_enters_slowly_before_the_end_of_a_lane() -> None:
    slow = speed_at(ROADS.arrays, KIND, MAIN[0], LENGTH - 6.5, 20.0)
    assert slow == pytest.approx(np.sqrt(2.0 * 2.0 * 2.0))
    assert speed_at(ROADS.arrays, KIND, MAIN[0], 10.0, 20.0) == 20.0


def test_a_departure_is_slow_only_before_a_line_with_a_conflict_or_a_signal() -> None:
    """A lower speed limit behind the line also makes the departure slow."""
    _, room = traffic()
    place_m = LENGTH - 12.0
    link = int(PLAN[0][MAIN[0]]["link"])
    words = (TRAVEL, traffic()[0], KEY, departure(speed_code=codes.SPEED_MAX), KIND, MAIN[0])
    links = ROADS.links.copy()
    links["num_conflicts"], links["signal"] = 0, -1
    free = ROADS.arrays._replace(links=links)
    assert entry_speed(free, *words, place_m, room) == pytest.approx(LIMIT)
    for field, value in (("num_conflicts", 1), ("signal", 0)):
        changed = links.copy()
        changed[field][link] = value
        slow = entry_speed(free._replace(links=changed), *words, place_m, room)
        assert slow == pytest.approx(speed_at(ROADS.arrays, KIND, MAIN[0], place_m, LIMIT))
        assert slow < LIMIT
    lanes = ROADS.lanes.copy()
    lanes["speed_mps"][PLAN[0][MAIN[0]]["next"]] = 2.0
    lower = entry_speed(free._replace(lanes=lanes), *words, place_m, room)
    assert lower == pytest.approx(np.hypot(2.0, np.sqrt(2.0 * 2.0 * 7.5)))


@pytest.mark.parametrize(
    ("behind_m", "pace", "brakes"),
    [(5.5, 0.0, True), (60.0, 15.0, False), (15.0, 25.0, True), (15.0, 0.0, False)],
)
def test_a_departure_is_refused_if_a_follower_would_brake_hard(
    behind_m: float, pace: float, brakes: bool
) -> None:
    cars, room = traffic((MAIN[0], 100.0 - behind_m, pace))
    found = follower_brakes(
        ROADS.arrays, TRAVEL, cars, departure(), KIND, MAIN[0], 100.0, 10.0, room
    )
    assert found == brakes


def test_all_followers_are_checked_not_only_the_nearest() -> None:
    """A fast vehicle is found although a standing vehicle on another link is nearer."""
    roads, ways = network("grid4x4"), travel("grid4x4")
    lane = next(
        k for k, row in enumerate(roads.lanes) if row["num_into"] > 1 and not row["internal"]
    )
    first = roads.lanes[lane]["first_into"]
    stands, comes = (int(roads.into[first + k]) for k in range(2))
    end_m = roads.lanes["length_m"]
    for near, far in ((stands, comes), (comes, stands)):
        cars = np.concatenate([
            on_lane(roads, near, float(end_m[near]) - 12.0, ways, id=1),
            on_lane(roads, far, float(end_m[far]) - 14.0, ways, speed=12.0, id=2),
        ])  # fmt: skip
        room = scratch(roads, 2)
        index_lanes(roads.arrays, ways, cars, 2, room)
        asked = (roads.arrays, ways, cars, departure(lane), KIND, lane, 2.5, 0.0, room)
        assert follower_brakes(*asked)
        cars[1]["speed"] = 0.0
        index_lanes(roads.arrays, ways, cars, 2, room)
        assert not follower_brakes(*asked)


@pytest.mark.parametrize(("rear_m", "safe"), [(-1.0, False), (30.0, True)])
def test_a_vehicle_on_another_link_is_a_leader_while_its_rear_is_before_the_fork(
    rear_m: float, safe: bool
) -> None:
    """The departure goes straight on. `rear_m`: how far the other rear is past the line."""
    roads, plans = network("grid4x4"), travel("grid4x4")
    lane, link, other = _fork(roads)
    plan = np.zeros(len(roads.lanes), _PLAN)
    plan["next"], plan["link"], plan["to_go"] = roads.links["next_lane"][link], link, 500.0
    ahead = int(roads.links["next_lane"][other])
    end_m = float(roads.lanes["length_m"][lane])
    place_m = min(rear_m + 2.5, float(roads.lanes["length_m"][ahead]))
    rows = on_lane(roads, ahead, place_m, plans, speed=0.0)
    room = scratch(roads, 1)
    index_lanes(roads.arrays, plans, rows, 1, room)
    waiting = departure(lane, speed_code=codes.SPEED_GIVEN, speed=6.0)
    found = entry_speed(
        roads.arrays, travel_by(plan), rows, KEY, waiting, KIND, lane, end_m - 14.0, room
    )
    assert (found == 6.0) == safe


@pytest.mark.parametrize(
    ("to_start_m", "fork_m", "brakes"), [(2.0, 3.0, True), (60.0, 3.0, False), (2.0, 1.0, False)]
)
def test_no_vehicle_enters_close_before_a_vehicle_that_turns_onto_another_lane(
    to_start_m: float, fork_m: float, brakes: bool
) -> None:
    """The departure enters behind a junction, on the lane that the straight link leads to.

    The other vehicle drives on another link from the same lane, at 10 m/s.

    Args:
        to_start_m: Distance of the other vehicle's front from the end of its link.
        fork_m: Length of the other link on which its path is near the straight link. The kernel
            adds 6 m for long vehicles.
    """
    roads, plans = network("grid4x4"), travel("grid4x4")
    _, link, other = _fork(roads)
    links = roads.links.copy()
    links["length_m"][[link, other]], links["fork_m"][[link, other]] = 8.0, fork_m
    inside = int(links["first_internal"][other])
    rows = on_lane(roads, inside, 8.0 - to_start_m - 2.5, plans, speed=10.0)
    room = scratch(roads, 1)
    index_lanes(roads.arrays, plans, rows, 1, room)
    lane = int(links["to_lane"][link])
    arrays = roads.arrays._replace(links=links)
    waiting = departure(lane)
    assert follower_brakes(arrays, plans, rows, waiting, KIND, lane, 2.5, 8.0, room) == brakes


def _fork(roads: Any) -> tuple[int, int, int]:
    """Return a lane and two links that begin there: the straight link and another link."""
    for lane in np.flatnonzero(roads.lanes["num_links"] > 1).tolist():
        first, num = roads.lanes["first_link"][lane], roads.lanes["num_links"][lane]
        links = range(first, first + num)
        straight = [link for link in links if roads.links["direction"][link] == ord("s")]
        if straight:
            return lane, straight[0], next(link for link in links if link not in straight)
    raise AssertionError("no lane forks")
