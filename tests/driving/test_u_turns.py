"""U-turns on roads with two lanes: conflicts, and where other vehicles wait."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.records.codes import DRIVER_BACKGROUND, HOLD_YIELD
from cavmarl.core.records.rows import SWEPT_BEYOND_M
from cavmarl.driving.kernels.drivers import decide
from cavmarl.driving.kernels.junctions.approach import register_links
from cavmarl.driving.kernels.junctions.swept_areas import stop_before_foe_sweep
from cavmarl.driving.kernels.lanes.lane_choice import change_is_safe
from cavmarl.driving.kernels.lanes.lane_ends import constraint_of_side_lane
from cavmarl.driving.kernels.lanes.lane_index import index_lanes
from cavmarl.driving.kernels.models.following import no_constraint
from cavmarl.driving.vehicle_types import generated_types
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import PLAN
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.traffic.kernels.admission import is_entry_swept, may_entry_be_swept
from tests.support.netgenerate import netgenerate
from tests.support.traffic import on_lane, scratch, travel_by

STRAIGHT, U_TURN = map(ord, "st")
BUS = 2  # size class of buses
BUS_M = 12.0


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> RoadNetwork:
    path = tmp_path_factory.mktemp("u_turns") / "grid.net.xml"
    options = ("--grid", "--grid.number=2", "--grid.attach-length=100", "--grid.length=110", "-L=2")
    return read_network(netgenerate(path, *options, "--default-junction-type=allway_stop"))


def beside(network: RoadNetwork) -> tuple[int, int]:
    """Return a straight link and the link of a U-turn from the adjacent lane."""
    for link, row in enumerate(network.links):
        lane = network.lanes[row["from_lane"]]
        if row["direction"] == STRAIGHT and lane["left"] >= 0:
            left = network.lanes[lane["left"]]
            for other in range(left["first_link"], left["first_link"] + left["num_links"]):
                if network.links["direction"][other] == U_TURN:
                    return link, other
    raise AssertionError("there is no U-turn beside a lane that leads on")


def sweeps_of(network: RoadNetwork, link: int) -> NDArray[np.void]:
    row = network.links[link]
    return network.sweeps[row["first_sweep"] :][: row["num_sweeps"]]


def test_a_u_turn_does_not_conflict_with_the_adjacent_lane(
    network: RoadNetwork,
) -> None:
    """While a vehicle turns, its rear is still on its own lane, which is straight."""
    link, turn = beside(network)
    row = network.links[link]
    foes = network.conflicts["foe"][row["first_conflict"] :][: row["num_conflicts"]]
    assert len(foes) > 0
    assert turn not in foes


@pytest.mark.parametrize(("size", "reaches"), [(0, False), (BUS, True)])
def test_only_long_vehicles_wait_in_a_u_turn_for_adjacent_vehicles(
    network: RoadNetwork, size: int, reaches: bool
) -> None:
    """After the turn, a long vehicle drives back on the target lane, next to these vehicles."""
    links, beyond_m = network.links, []
    for turn in np.flatnonzero(links["direction"] == U_TURN):
        sweeps = sweeps_of(network, turn)
        same = links["to_lane"][sweeps["foe"]] == links["to_lane"][turn]
        asked = sweeps[(sweeps["own"] == size) & same & (sweeps["foe"] != turn)]
        beyond_m += (asked["foe_leave_m"] - links["length_m"][asked["foe"]]).tolist()
    assert beyond_m
    assert (min(beyond_m) > 2.0) == reaches


def test_a_bus_in_a_u_turn_reaches_far_over_the_adjacent_lane(network: RoadNetwork) -> None:
    """The area ends over 5 m beyond the junction, but within `SWEPT_BEYOND_M`.

    Vehicles whose rear is within that distance are registered, so the bus knows them.
    """
    links, beyond_m = network.links, []
    for turn in np.flatnonzero(links["direction"] == U_TURN):
        sweeps = sweeps_of(network, turn)
        foes = sweeps["foe"][sweeps["own"] == BUS]
        beside = links["to_lane"][foes] != links["to_lane"][turn]
        leave_m = sweeps["foe_leave_m"][sweeps["own"] == BUS] - links["length_m"][foes]
        beyond_m += leave_m[beside].tolist()
    assert 5.0 < max(beyond_m) < SWEPT_BEYOND_M


@pytest.mark.parametrize(("bus_m", "brakes"), [(6.0, True), (40.0, False)])
def test_a_vehicle_between_two_lanes_waits_before_an_area_of_the_lane_that_it_leaves(
    network: RoadNetwork, bus_m: float, brakes: bool
) -> None:
    """A bus in a U-turn sweeps over the end of the lane that the car leaves."""
    link, turn = beside(network)
    row, sweeps = network.links[link], sweeps_of(network, link)
    picked = (sweeps["foe"] == turn) & (sweeps["own"] == 0) & (sweeps["other"] == BUS)
    (enter_m,) = sweeps["enter_m"][picked]
    lane, left = int(row["from_lane"]), int(network.lanes["left"][row["from_lane"]])
    length_m = float(network.lanes["length_m"][lane])
    travel = travel_by(np.zeros(len(network.lanes), PLAN))
    s = length_m + float(enter_m) - 6.0 - 2.5
    rows = on_lane(network, left, s, travel, id=0, length=5.0, speed=6.0, side_lane=lane)
    room = scratch(network, 1)
    room.link_start[:] = room.link_end[:] = 0
    rows = np.concatenate([rows, rows])
    rows["id"], rows["hold"] = (0, 1), 0
    room.link_end[turn] = 1
    bus = room.approach[0]
    bus["row"], bus["id"], bus["half"] = 1, 1, 0.5 * BUS_M
    bus["dist"], bus["speed"] = 0.5 * BUS_M - bus_m, 2.0
    kind = generated_types()[0]
    found = constraint_of_side_lane(network.arrays, travel, rows, 0, kind, 100.0, 0.1, room)
    assert (found > no_constraint(kind)) == brakes


@pytest.mark.parametrize(("foe_m", "waits"), [(-20.0, False), (2.0, True)])
def test_a_bus_leaves_room_for_a_bus_in_a_u_turn_ahead_but_not_for_one_behind(
    network: RoadNetwork, foe_m: float, waits: bool
) -> None:
    _, turn = beside(network)
    row, sweeps = network.links[turn], sweeps_of(network, turn)
    (sweep,) = sweeps[(sweeps["foe"] == turn) & (sweeps["own"] == BUS) & (sweeps["other"] == BUS)]
    lane, own_m = int(row["from_lane"]), float(sweep["enter_m"]) - 1.0
    length_m = float(network.lanes["length_m"][lane])
    plan = np.zeros(len(network.lanes), PLAN)
    plan["next"], plan["link"] = row["next_lane"], turn
    travel = travel_by(plan)
    places = [own_m, foe_m]
    rows = np.concatenate(
        [on_lane(network, lane, length_m + min(m, 0.0) - 0.5 * BUS_M, travel, id=k, length=BUS_M)
         for k, m in enumerate(places)]
    )  # fmt: skip
    room = scratch(network, 2)
    register_links(network.arrays, travel, rows, 2, np.zeros(2, PLAN), np.zeros(2, np.int64), room)
    room.approach["dist"][room.approach["row"] == 1] = 0.5 * BUS_M - foe_m
    stop = stop_before_foe_sweep(network.arrays, rows, 0, turn, own_m, np.inf, room)
    assert stop == (sweep["enter_m"] if waits else np.inf)


def test_the_rear_of_a_bus_in_a_u_turn_reaches_followers_on_its_lane(
    network: RoadNetwork,
) -> None:
    """The rear of a bus moves back in the turn; the rear of a car does not."""
    _, turn = beside(network)
    sweeps = sweeps_of(network, turn)
    behind = sweeps[(sweeps["foe"] == turn) & (sweeps["own"] == 0)]
    (bus,) = behind[behind["other"] == BUS]
    assert not (behind["other"] == 0).any()
    assert 0.0 < bus["foe_enter_m"] < BUS_M - 3.0, "the rear of the bus is beyond the line"
    assert bus["enter_m"] < bus["foe_enter_m"] - BUS_M + 1.0, (
        "the area does not extend back to the position of the rear"
    )


@pytest.mark.parametrize("turns", [True, False])
def test_the_gap_to_a_bus_in_a_u_turn_is_larger(network: RoadNetwork, turns: bool) -> None:
    link, turn = beside(network)
    taken = turn if turns else link
    lane = int(network.links["from_lane"][taken])
    plan = np.zeros(len(network.lanes), PLAN)
    plan["next"][lane], plan["link"][lane] = network.links["next_lane"][taken], taken
    travel, length_m = travel_by(plan), float(network.lanes["length_m"][lane])
    kind = generated_types()[0]

    def stands_m(length: float) -> float:
        """Return the smallest gap, in steps of 0.25 m, at which a standing vehicle starts."""
        for gap_m in np.arange(0.25, 9.0, 0.25):
            rear_m = length_m - 1.0 - length
            places = [(rear_m - gap_m - 2.5, 5.0), (rear_m + 0.5 * length, length)]
            rows = np.concatenate(
                [on_lane(network, lane, s, travel, id=k, length=long, driver=DRIVER_BACKGROUND,
                         speed=0.0) for k, (s, long) in enumerate(places)]
            )  # fmt: skip
            room, step = scratch(network, 2), np.zeros(2, PLAN)
            index_lanes(network.arrays, travel, rows, 2, room)
            register_links(network.arrays, travel, rows, 2, step, np.zeros(2, np.int64), room)
            phase = np.zeros(0, np.int32)
            decide(network.arrays, travel, rows, 1, DRIVER_BACKGROUND, 0, 0.1, phase, step, room)
            if room.accel[0] > 0.1:
                return float(gap_m)
        raise AssertionError("the vehicle never starts")

    further_m = stands_m(BUS_M) - stands_m(kind["length"])
    assert further_m == pytest.approx(3.0 if turns else 0.0, abs=0.3)


@pytest.mark.parametrize(("bus_m", "swept"), [(6.0, True), (40.0, False), (None, False)])
def test_no_vehicle_enters_beside_a_bus_in_a_u_turn(
    network: RoadNetwork, bus_m: float | None, swept: bool
) -> None:
    """`bus_m` is the distance of the front of the bus beyond its line, or None without a bus."""
    links, sweeps = network.links, network.sweeps
    owner = np.repeat(np.arange(len(links)), links["num_sweeps"])
    reaches = (sweeps["own"] == 0) & (sweeps["other"] == BUS)
    reaches &= links["direction"][sweeps["foe"]] == U_TURN
    reaches &= sweeps["leave_m"] > links["length_m"][owner] + 0.5
    picked = int(np.flatnonzero(reaches)[0])
    lane, turn = int(links["to_lane"][owner[picked]]), int(sweeps["foe"][picked])
    nowhere = np.zeros(len(network.lanes), PLAN)
    nowhere["next"], nowhere["link"] = -1, -1
    travel = travel_by(nowhere)
    row = on_lane(network, lane, 2.5, travel, id=0)[0]
    room = scratch(network, 2)
    inside = int(links["first_internal"][turn])
    buses = on_lane(network, inside, 1.0, travel, id=1, length=BUS_M)
    index_lanes(network.arrays, travel, buses, 0 if bus_m is None else 1, room)
    room.link_start[:] = room.link_end[:] = 0
    if bus_m is not None:
        room.link_end[turn] = 1
        room.approach["half"][0], room.approach["dist"][0] = 0.5 * BUS_M, 0.5 * BUS_M - bus_m
    assert bus_m is None or may_entry_be_swept(network.arrays, travel, row, room)
    assert is_entry_swept(network.arrays, travel, row, room) == swept
    row["s"] = 30.0
    assert not is_entry_swept(network.arrays, travel, row, room), (
        "a vehicle that enters 30 m further on is swept"
    )


def u_turn_without_other_links(network: RoadNetwork) -> tuple[int, int]:
    """Return a U-turn and the lane beside its target lane, to which no link leads."""
    for turn in np.flatnonzero(network.links["direction"] == U_TURN).tolist():
        right = int(network.lanes["right"][network.links["to_lane"][turn]])
        if right >= 0 and network.lanes["num_into"][right] == 0:
            return turn, right
    raise AssertionError("no U-turn is the only link to a road of two lanes")


@pytest.mark.parametrize(("s", "listed"), [(3.0, True), (30.0, False)])
def test_a_vehicle_on_a_lane_without_a_link_is_listed_at_the_link_of_the_adjacent_lane(
    network: RoadNetwork, s: float, listed: bool
) -> None:
    turn, lane = u_turn_without_other_links(network)
    nowhere = np.zeros(len(network.lanes), PLAN)
    nowhere["next"], nowhere["link"] = -1, -1
    travel = travel_by(nowhere)
    rows = on_lane(network, lane, s, travel, id=0, length=5.0, speed=0.0)
    room, step = scratch(network, 1), np.zeros(1, PLAN)
    register_links(network.arrays, travel, rows, 1, step, np.zeros(1, np.int64), room)
    assert (room.link_end[turn] > room.link_start[turn]) == listed
    if listed:
        entry = room.approach[room.link_start[turn]]
        assert entry["dist"] == pytest.approx(-network.links["length_m"][turn] - s)


@pytest.mark.parametrize("size", [0, BUS])
def test_a_bus_before_a_u_turn_waits_for_vehicles_that_have_entered_beside_its_target_lane(
    network: RoadNetwork, size: int
) -> None:
    """Vehicles beside the target lane are registered at the U-turn, which is its own foe."""
    turn, lane = u_turn_without_other_links(network)
    length_m = float(network.links["length_m"][turn])
    sweeps = sweeps_of(network, turn)
    own = sweeps[(sweeps["foe"] == turn) & (sweeps["own"] == BUS) & (sweeps["other"] == size)]
    (area,) = own[own["foe_leave_m"] >= length_m]
    assert area["enter_m"] < length_m + 0.5 * BUS_M
    assert area["foe_enter_m"] >= length_m
    rows = np.concatenate([on_lane(network, lane, 0.0, id=k, length=BUS_M) for k in (0, 1)])
    rows["wait_s"] = 0.0
    room = scratch(network, 1)
    room.link_start[:] = room.link_end[:] = 0
    room.link_end[turn] = 1
    half_m = 0.5 * (BUS_M if size == BUS else 5.0)
    other = room.approach[0]
    other["row"], other["id"], other["half"] = 1, 1, half_m
    for s, waits in ((half_m + 0.5, True), (half_m + 20.0, False)):
        other["dist"] = -length_m - s
        stop_m = stop_before_foe_sweep(network.arrays, rows, 0, turn, -5.0, -np.inf, room)
        assert (stop_m < np.inf) == waits


@pytest.mark.parametrize(("place_m", "stands_at_sign"), [(-9.5, True), (-16.0, False)])
def test_a_bus_that_leaves_room_before_a_stop_sign_waits_at_the_sign_if_it_is_near(
    network: RoadNetwork, place_m: float, stands_at_sign: bool
) -> None:
    link, turn = beside(network)
    plan = np.zeros(len(network.lanes), PLAN)
    for way in (link, turn):
        lane = network.links["from_lane"][way]
        plan["next"][lane], plan["link"][lane] = network.links["next_lane"][way], way
    travel = travel_by(plan)
    lanes = network.links["from_lane"][[link, turn]].tolist()
    ends_m = network.lanes["length_m"][lanes] - 0.5 * BUS_M
    common = {"length": BUS_M, "driver": DRIVER_BACKGROUND, "stopped_at": -1, "hold": HOLD_YIELD}
    rows = np.concatenate(
        [on_lane(network, lane, end_m + front_m, travel, id=k, **common)
         for k, (lane, end_m, front_m) in enumerate(
             zip(lanes, ends_m.tolist(), (place_m, -1.0), strict=True))]
    )  # fmt: skip
    room, step = scratch(network, 2), np.zeros(2, PLAN)
    index_lanes(network.arrays, travel, rows, 2, room)
    register_links(network.arrays, travel, rows, 2, step, np.zeros(2, np.int64), room)
    phase = np.zeros(0, np.int32)
    decide(network.arrays, travel, rows, 2, DRIVER_BACKGROUND, 0, 0.1, phase, step, room)
    assert room.hold[0] == HOLD_YIELD
    assert (room.link_ahead[0] == link) == stands_at_sign


@pytest.mark.parametrize(("turned_rad", "nearer"), [(1.6, True), (-1.6, True), (0.5, False)])
def test_the_gap_to_a_leader_turned_by_90_degrees_is_smaller_by_half_its_width(
    network: RoadNetwork, turned_rad: float, nearer: bool
) -> None:
    link, _ = beside(network)
    lane, ahead = (int(network.links[name][link]) for name in ("from_lane", "next_lane"))
    plan = np.zeros(len(network.lanes), PLAN)
    plan["next"][lane], plan["link"][lane] = ahead, link
    travel, length_m = travel_by(plan), float(network.lanes["length_m"][lane])

    def accel(turned: float, back_m: float) -> float:
        places = [(lane, length_m - 3.0), (ahead, 7.0 - back_m)]
        rows = np.concatenate(
            [on_lane(network, at, s, travel, id=k, driver=DRIVER_BACKGROUND)
             for k, (at, s) in enumerate(places)]
        )  # fmt: skip
        rows["heading"][1] += turned
        room, step = scratch(network, 2), np.zeros(2, PLAN)
        index_lanes(network.arrays, travel, rows, 2, room)
        room.link_start[:] = room.link_end[:] = 0  # no vehicle is on the junction
        step[0] = plan[lane]
        decide(network.arrays, travel, rows, 2, DRIVER_BACKGROUND, 0, 0.1,
               np.zeros(0, np.int32), step, room)  # fmt: skip
        return float(room.accel[0])

    half_m = 0.5 * float(on_lane(network, lane, 0.0)["width"][0])
    assert accel(turned_rad, 0.0) == pytest.approx(accel(0.0, half_m if nearer else 0.0))
    assert accel(0.0, 0.0) > accel(0.0, half_m)


@pytest.mark.parametrize(("rest_m", "announced"), [(6.0, True), (20.0, False)])
def test_a_vehicle_that_changes_lanes_near_the_line_is_listed_for_both_lanes(
    network: RoadNetwork, rest_m: float, announced: bool
) -> None:
    """A bus in a U-turn from the lane that the vehicle leaves could otherwise sweep over it."""
    link, turn = beside(network)
    lane, left = (int(network.links["from_lane"][k]) for k in (link, turn))
    plan = np.zeros(len(network.lanes), PLAN)
    plan["next"][lane], plan["link"][lane] = network.links["next_lane"][link], link
    travel, length_m = travel_by(plan), float(network.lanes["length_m"][lane])
    row = on_lane(network, lane, length_m - rest_m, travel, id=7, side_lane=left)
    room = scratch(network, 1)
    register_links(network.arrays, travel, row, 1, np.zeros(1, PLAN), np.zeros(1, np.int64), room)
    first = int(network.lanes["first_link"][left])
    found = room.approach[room.link_start[first] : room.link_end[first]]
    assert found["id"].tolist() == ([7] if announced else [])
    assert found["dist"].tolist() == pytest.approx([rest_m] if announced else [], abs=0.1)


@pytest.mark.parametrize(("gap_m", "over_m", "safe"), [
    (1.5, -8.0, True), (1.5, 1.0, False), (1.5, 4.0, False), (3.0, 1.0, True), (3.0, 4.0, True),
])  # fmt: skip
def test_a_lane_change_close_behind_a_vehicle_in_a_u_turn_is_unsafe(
    network: RoadNetwork, gap_m: float, over_m: float, safe: bool
) -> None:
    """The body of that vehicle extends further back than its rear on the path."""
    link, turn = beside(network)
    lane, left = (int(network.links["from_lane"][k]) for k in (link, turn))
    plan = np.zeros(len(network.lanes), PLAN)
    for way in (link, turn):
        at = network.links["from_lane"][way]
        plan["next"][at], plan["link"][at] = network.links["next_lane"][way], way
    types = generated_types().copy()
    types["min_gap"] = 2.5
    travel, length_m = travel_by(plan, types), float(network.lanes["length_m"][lane])
    ahead = length_m + over_m - 2.5
    place = (left, ahead) if ahead < length_m else (int(plan["next"][left]), ahead - length_m)
    cars = [place, (lane, ahead - 5.0 - gap_m)]
    rows = np.concatenate(
        [on_lane(network, at, s, travel, id=k, length=5.0, link=turn if k == 0 else -1)
         for k, (at, s) in enumerate(cars)]
    )  # fmt: skip
    room = scratch(network, 2)
    index_lanes(network.arrays, travel, rows, 2, room)
    register_links(network.arrays, travel, rows, 2, np.zeros(2, PLAN), np.zeros(2, np.int64), room)
    assert change_is_safe(network.arrays, travel, rows, 1, left, 0.0, True, room) == safe
