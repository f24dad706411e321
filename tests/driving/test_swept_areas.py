"""Areas that long vehicles sweep in bends, and vehicles that wait before these areas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.records.arrays import Scratch
from cavmarl.core.records.codes import (
    DRIVER_BACKGROUND,
    HOLD_EXIT_BLOCKED,
    HOLD_NONE,
    HOLD_SIGNAL,
    HOLD_YIELD,
    MODEL_KRAUSS,
)
from cavmarl.core.records.rows import STEERED
from cavmarl.driving.kernels.drivers import decide, decide_at_line
from cavmarl.driving.kernels.junctions.approach import APPROACH
from cavmarl.driving.kernels.junctions.swept_areas import (
    GIVE_UP_S,
    behind_fork,
    foe_would_sweep_over,
    room_m,
    stop_before_foe_sweep,
    wait_place,
)
from cavmarl.driving.kernels.lanes.lane_index import index_lanes
from cavmarl.driving.kernels.models.following import behind, no_constraint
from cavmarl.driving.vehicle_types import generated_types, set_model
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import PLAN
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.demand_worlds import make
from tests.support.driving import drive, start
from tests.support.netgenerate import netgenerate
from tests.support.traffic import on_lane, scratch, travel_by

GRID = ("--grid", "--grid.number=3", "--grid.length=80", "--no-turnarounds.except-deadend")
CLOCK = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.5}
CAR, BUS = 0, 2  # size classes
CAR_M, BUS_M = 5.0, 12.0
CROWD = """<routes>
  <vType id="bus" vClass="bus" length="12" width="2.5"/>
  <vType id="car" length="5"/>
  <flow id="turns" type="bus" from="A1B1" to="B1B0" begin="0" end="150" period="15"/>
  <flow id="left" type="bus" from="B2B1" to="B1C1" begin="0" end="150" period="15"/>
  <flow id="north" type="car" from="B0B1" to="B1B2" begin="0" end="150" period="5"/>
  <flow id="west" type="car" from="C1B1" to="B1A1" begin="0" end="150" period="5"/>
</routes>"""


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return netgenerate(tmp_path_factory.mktemp("swept") / "grid.net.xml", *GRID)


@pytest.fixture(scope="module")
def network(path: Path) -> RoadNetwork:
    return read_network(path)


def bus_over_a_line(network: RoadNetwork) -> tuple[int, np.void]:
    """Return a link and its row of SWEEP for a bus that sweeps over another link's stop line."""
    for link, row in enumerate(network.links):
        for sweep in network.sweeps[row["first_sweep"] :][: row["num_sweeps"]]:
            over = sweep["own"] == BUS and sweep["other"] == CAR and sweep["foe_enter_m"] < -1.5
            if over and sweep["enter_m"] > 1.0:
                return link, sweep
    raise AssertionError("no bus sweeps over a line")


def test_each_swept_area_has_a_row_on_both_links(network: RoadNetwork) -> None:
    own = np.repeat(np.arange(len(network.links)), network.links["num_sweeps"])
    rows = {
        (int(link), *(row[name].item() for name in network.sweeps.dtype.names or ()))
        for link, row in zip(own, network.sweeps, strict=True)
    }
    assert len(rows) == len(network.sweeps) > 100
    for link, foe, size, other, enter, leave, foe_enter, foe_leave in rows:
        assert (foe, link, other, size, foe_enter, foe_leave, enter, leave) in rows


def test_each_link_records_the_smallest_size_class_that_sweeps_over_its_cars(
    network: RoadNetwork,
) -> None:
    found = set()
    for row in network.links:
        sweeps = network.sweeps[row["first_sweep"] :][: row["num_sweeps"]]
        over_cars = sweeps["other"][sweeps["own"] == CAR].tolist()
        assert row["swept_by"] == min(over_cars, default=STEERED)
        found.add(int(row["swept_by"]))
    assert found >= {BUS, STEERED}


def test_buses_but_not_cars_sweep_over_stop_lines(network: RoadNetwork) -> None:
    over = network.sweeps[network.sweeps["foe_enter_m"] < -1.0]
    assert not ((over["own"] == CAR) & (over["other"] == CAR)).any()
    assert ((over["own"] == BUS) & (over["other"] == CAR)).any()


class BusAndCar:
    """A bus before a link, and a car before the stop line that the bus sweeps over.

    Vehicle 0 is the bus, vehicle 1 the car.
    """

    def __init__(self, network: RoadNetwork) -> None:
        self.network = network
        self.link, self.sweep = bus_over_a_line(network)
        lanes = [int(network.links[k]["from_lane"]) for k in (self.link, self.sweep["foe"])]
        self.rows = np.concatenate(
            [on_lane(network, lane, 30.0, id=k, length=length, hold=HOLD_NONE)
             for k, (lane, length) in enumerate(zip(lanes, (BUS_M, CAR_M), strict=True))]
        )  # fmt: skip

    def _announced(self, asks: int, places: tuple[float, float]) -> Scratch:
        """Register the vehicle other than `asks`; `places`: fronts in m beyond the lines."""
        room = scratch(self.network, 2)
        other = 1 - asks
        links = (self.link, int(self.sweep["foe"]))
        entry = np.zeros(1, APPROACH)
        half = 0.5 * self.rows["length"][other]
        entry["link"], entry["row"], entry["id"], entry["half"] = links[other], other, other, half
        entry["dist"], entry["speed"] = half - places[other], self.rows["speed"][other]
        room.approach[0] = entry[0]
        room.link_start[:] = room.link_end[:] = 0
        room.link_end[links[other]] = 1
        return room

    def stop(self, asks: int, places: tuple[float, float], room_m: float = -np.inf) -> float:
        """Return where the front of the vehicle `asks` (0 or 1) has to stop, or inf."""
        room, roads = self._announced(asks, places), self.network.arrays
        link = (self.link, int(self.sweep["foe"]))[asks]
        return float(
            stop_before_foe_sweep(roads, self.rows, asks, link, places[asks], room_m, room)
        )

    def car_is_swept(self, places: tuple[float, float]) -> bool:
        """Return whether the bus would sweep over a car that enters the road at the car's place."""
        room, roads, link = self._announced(1, places), self.network.arrays, self.sweep["foe"]
        return bool(foe_would_sweep_over(roads, self.rows[1], link, places[1], room))


def test_a_bus_waits_before_the_junction_for_a_car_that_stands_at_the_line(
    network: RoadNetwork,
) -> None:
    meeting = BusAndCar(network)
    assert meeting.stop(0, (-2.0, -1.0)) == 0.0
    meeting.rows["speed"][1] = 3.0  # the car drives, so the bus may wait at the area
    assert meeting.stop(0, (-2.0, -1.0)) == meeting.sweep["enter_m"]
    assert meeting.stop(0, (-2.0, 30.0)) == np.inf


def test_a_car_that_has_to_stop_anyway_leaves_room_for_a_bus(network: RoadNetwork) -> None:
    meeting = BusAndCar(network)
    enter_m = meeting.sweep["foe_enter_m"]
    meeting.rows["hold"][0] = HOLD_SIGNAL  # the bus waits for green
    red, inside = room_m(HOLD_SIGNAL, HOLD_NONE), room_m(HOLD_NONE, HOLD_YIELD)
    assert meeting.stop(1, (-20.0, -12.0), red) == enter_m
    assert meeting.stop(1, (-40.0, -12.0), red) == np.inf
    assert meeting.stop(1, (-40.0, -12.0), inside) == enter_m, (
        "a car inside the junction blocks the bus"
    )
    meeting.rows["speed"][0] = 15.0  # a fast bus arrives soon from the same distance
    assert meeting.stop(1, (-40.0, -12.0), red) == enter_m
    meeting.rows["speed"][0] = 0.0
    assert meeting.stop(1, (-2.0, -12.0)) == np.inf, (
        "a car that nothing else stops waits for the bus"
    )


@pytest.mark.parametrize(("over_m", "goes"), [(0.0, False), (1e-9, False), (0.1, True)])
def test_a_vehicle_that_stands_at_the_border_of_an_area_is_outside(
    network: RoadNetwork, over_m: float, goes: bool
) -> None:
    """The other vehicle is in the area. Rounding of the front's position must not matter."""
    meeting = BusAndCar(network)
    enter_m, car_m = (float(meeting.sweep[name]) for name in ("enter_m", "foe_enter_m"))
    stop_m = meeting.stop(0, (enter_m + over_m, car_m + 0.5))
    assert (stop_m == np.inf) == goes


@pytest.mark.parametrize(
    ("hold", "wait_s", "goes"),
    [
        (HOLD_EXIT_BLOCKED, GIVE_UP_S + 0.1, True),
        (HOLD_EXIT_BLOCKED, GIVE_UP_S, False),
        (HOLD_SIGNAL, GIVE_UP_S + 0.1, False),
    ],
)
def test_a_bus_passes_a_car_that_has_waited_long_for_the_bus(
    network: RoadNetwork, hold: int, wait_s: float, goes: bool
) -> None:
    """The bus, which begins to move, has a waiting time of 0; the car's waiting time goes on."""
    meeting = BusAndCar(network)
    enter_m, car_m = (float(meeting.sweep[name]) for name in ("enter_m", "foe_enter_m"))
    meeting.rows["speed"], meeting.rows["wait_s"] = (0.1, 0.0), (0.0, wait_s)
    meeting.rows["hold"] = (HOLD_NONE, hold)
    assert (meeting.stop(0, (enter_m, car_m + 0.5)) == np.inf) == goes


def test_long_vehicles_wait_inside_before_swept_areas(network: RoadNetwork) -> None:
    """A bus also waits before areas that begin up to 3 m before the map's waiting position."""
    earlier = 0
    for link in np.flatnonzero(network.links["wait_m"] < np.inf).tolist():
        row = network.links[link]
        sweeps = network.sweeps[row["first_sweep"] :][: row["num_sweeps"]]
        place = wait_place(network.arrays, link, 0.5 * BUS_M)
        begins = sweeps["enter_m"][sweeps["own"] == BUS]
        begins = begins[begins > max(row["wait_m"] - 3.0, 0.0)]
        assert place == min([row["wait_m"], *begins])
        assert wait_place(network.arrays, link, 0.5 * CAR_M) == row["wait_m"]
        earlier += place < row["wait_m"]
    assert earlier > 0


def test_a_car_approaches_a_bus_inside_at_least_as_cautiously_as_an_empty_junction(
    network: RoadNetwork,
) -> None:
    """The bus sweeps an area beyond the waiting position, and may leave before the car arrives."""
    links, sweeps, conflicts = network.links, network.sweeps.copy(), network.conflicts.copy()
    owner = np.repeat(np.arange(len(links)), links["num_sweeps"])
    picked = (sweeps["own"] == CAR) & (sweeps["other"] == BUS)
    place = int(np.flatnonzero(picked & np.isfinite(links["wait_m"][owner]))[0])
    link, sweep = int(owner[place]), sweeps[place]
    sweep["enter_m"], sweep["leave_m"] = links["wait_m"][link] + 8.0, links["length_m"][link]
    conflicts["must_yield"] = False
    roads = network.arrays._replace(sweeps=sweeps, conflicts=conflicts)
    nowhere = np.zeros(len(network.lanes), PLAN)
    nowhere["next"], nowhere["link"] = -1, -1
    types = np.array(generated_types())
    set_model(types, MODEL_KRAUSS)
    types["decel"] = 4.5
    travel, lane = travel_by(nowhere, types), int(links["from_lane"][link])
    front_m = 9.0
    s = float(network.lanes["length_m"][lane]) - front_m - 0.5 * CAR_M
    rows = [on_lane(network, lane, s, travel, id=k, length=CAR_M, speed=10.0) for k in (0, 1)]
    rows = np.concatenate(rows)
    rows["hold"] = rows["wait_s"] = 0
    phase = network.signals["program"].astype(np.int32)

    def held(bus: bool) -> float:
        room = scratch(network, 1)
        room.link_start[:] = room.link_end[:] = 0
        room.link_end[sweep["foe"]] = int(bus)
        entry = room.approach[0]
        entry["link"], entry["row"], entry["id"], entry["half"] = sweep["foe"], 1, 1, 0.5 * BUS_M
        entry["dist"] = 0.5 * BUS_M - float(sweep["foe_enter_m"]) - 1.0
        entry["speed"] = 2.0
        found, hold, _ = decide_at_line(
            roads, travel, rows, 0, types[0], link, front_m + 0.5 * CAR_M, 0, phase, 0.1, room,
        )  # fmt: skip
        assert hold == HOLD_NONE
        return float(found)

    assert held(bus=False) > no_constraint(types[0])
    assert held(bus=True) >= held(bus=False)


def test_the_vehicle_nearer_to_an_area_goes_first(network: RoadNetwork) -> None:
    meeting = BusAndCar(network)
    enter_m, bus_enter_m = meeting.sweep["foe_enter_m"], meeting.sweep["enter_m"]
    places = (bus_enter_m - 1.0, enter_m - 1.0)
    assert meeting.stop(1, places) == enter_m
    assert meeting.stop(0, places) == np.inf
    meeting.rows["speed"][1] = 15.0  # the car can no longer stop
    assert meeting.stop(0, (bus_enter_m - 9.0, enter_m - 6.0)) == bus_enter_m


def test_the_vehicle_that_has_to_brake_less_waits_if_neither_can_stop_in_time(
    network: RoadNetwork,
) -> None:
    """Each driver computes both decisions, so that exactly one vehicle waits."""
    meeting = BusAndCar(network)
    enter_m, bus_enter_m = meeting.sweep["foe_enter_m"], meeting.sweep["enter_m"]
    meeting.rows["speed"] = 4.0, 12.0
    for bus_m, car_m, car_waits in ((1.0, 15.0, True), (1.8, 15.0, False), (1.0, 8.0, False)):
        places = (bus_enter_m - bus_m, enter_m - car_m)
        assert meeting.stop(1, places) == (enter_m if car_waits else np.inf)
        assert meeting.stop(0, places) == (np.inf if car_waits else bus_enter_m)


def test_a_foe_that_stands_before_the_area_without_a_reason_is_ignored(
    network: RoadNetwork,
) -> None:
    """A foe may stand behind a leader that waits for the car. If the car waits, all three wait."""
    meeting = BusAndCar(network)
    enter_m, bus_enter_m = meeting.sweep["foe_enter_m"], meeting.sweep["enter_m"]
    meeting.rows["wait_s"][0] = 4.0
    assert meeting.stop(1, (bus_enter_m - 1.0, enter_m - 1.0)) == np.inf
    assert meeting.stop(1, (bus_enter_m + 1.0, enter_m - 1.0)) == enter_m, (
        "the car ignores a bus in the area"
    )
    meeting.rows["speed"][0] = 1.0
    assert meeting.stop(1, (bus_enter_m - 1.0, enter_m - 1.0)) == enter_m, (
        "the car ignores a bus that drives"
    )


@pytest.mark.parametrize(
    ("front_m", "bus_m", "brakes"),
    [(-2.0, 1.0, True), (-2.0, 80.0, False), (0.5, 40.0, False)],
)
def test_a_vehicle_behind_the_junction_waits_before_a_swept_area(
    network: RoadNetwork, front_m: float, bus_m: float, brakes: bool
) -> None:
    """`front_m` and `bus_m`: how far the fronts of car and bus are beyond the area's start."""
    meeting = BusAndCar(network)
    link, bus_link = int(meeting.sweep["foe"]), meeting.link
    row, sweeps = network.links[link], network.sweeps.copy()
    owner = np.repeat(np.arange(len(network.links)), network.links["num_sweeps"])
    picked = (owner == link) & (sweeps["foe"] == bus_link) & (sweeps["own"] == CAR)
    picked &= sweeps["other"] == BUS
    assert picked.sum() == 1
    enter_m = float(row["length_m"]) + 0.5 * CAR_M + 3.0
    sweeps["enter_m"][picked], sweeps["leave_m"][picked] = enter_m, enter_m
    sweeps["foe_leave_m"][picked] = meeting.sweep["enter_m"] + 50.0
    roads = network.arrays._replace(sweeps=sweeps)
    lane = int(row["to_lane"])
    nowhere = np.zeros(len(network.lanes), PLAN)
    nowhere["next"], nowhere["link"] = -1, -1
    nowhere["to_go"] = nowhere["room"] = 1000.0
    travel = travel_by(nowhere)
    s = 3.0 + front_m
    rows = on_lane(network, lane, s, travel, id=0, length=CAR_M, speed=2.0, link=link, way=0)
    rows["driver"] = DRIVER_BACKGROUND
    rows = np.concatenate([rows, meeting.rows[:1]])
    rows["id"], rows["hold"] = (0, 1), HOLD_NONE
    room, step = scratch(network, 2), np.zeros(2, PLAN)
    index_lanes(roads, travel, rows, 1, room)
    entry = room.approach[0]
    entry["link"], entry["row"], entry["id"], entry["half"] = bus_link, 1, 1, 0.5 * BUS_M
    entry["dist"], entry["speed"] = 0.5 * BUS_M - (meeting.sweep["enter_m"] + bus_m), 3.0
    room.link_start[:] = room.link_end[:] = 0
    room.link_end[bus_link] = 1
    step[0] = nowhere[lane]
    phase = network.signals["program"].astype(np.int32)
    decide(roads, travel, rows, 1, DRIVER_BACKGROUND, 0, 0.1, phase, step, room)
    assert (room.accel[0] < -0.5) == brakes


@pytest.mark.parametrize(("bus_m", "brakes"), [(1.0, True), (40.0, False)])
def test_a_vehicle_that_arrives_waits_for_a_bus_that_sweeps_over_the_lane_end(
    network: RoadNetwork, bus_m: float, brakes: bool
) -> None:
    meeting = BusAndCar(network)
    link, other = meeting.sweep["foe"], meeting.link
    lane = int(network.links["from_lane"][link])
    length_m = float(network.lanes["length_m"][lane])
    plan = np.zeros(len(network.lanes), PLAN)
    plan["next"], plan["link"], plan["to_go"], plan["room"] = -1, -1, length_m, length_m
    travel = travel_by(plan)
    front_m = float(meeting.sweep["foe_enter_m"]) - 8.0
    rows = on_lane(network, lane, length_m + front_m - 0.5 * CAR_M, travel, speed=6.0)
    rows["driver"], rows["length"], rows["width"] = DRIVER_BACKGROUND, CAR_M, 1.8
    rows = np.concatenate([rows, meeting.rows[:1]])
    rows["id"] = 0, 1
    room, step = scratch(network, 2), np.zeros(2, PLAN)
    index_lanes(network.arrays, travel, rows, 1, room)
    entry = room.approach[0]
    entry["link"], entry["row"], entry["id"], entry["half"] = other, 1, 1, 0.5 * BUS_M
    entry["dist"], entry["speed"] = 0.5 * BUS_M - (meeting.sweep["enter_m"] + bus_m), 3.0
    room.link_start[:] = room.link_end[:] = 0
    room.link_end[other] = 1
    step[0] = plan[lane]
    decide(network.arrays, travel, rows, 1, DRIVER_BACKGROUND, 0, 0.1,
           np.zeros(0, np.int32), step, room)  # fmt: skip
    assert (room.accel[0] < -1.0) == brakes


def test_a_car_must_not_enter_the_road_where_a_bus_sweeps(
    network: RoadNetwork,
) -> None:
    meeting = BusAndCar(network)
    enter_m, leave_m = (float(meeting.sweep[name]) for name in ("enter_m", "leave_m"))
    at_line, far = -0.5, float(meeting.sweep["foe_enter_m"]) - 1.0
    assert meeting.car_is_swept((enter_m + 1.0, at_line))
    assert not meeting.car_is_swept((leave_m + BUS_M + 1.0, at_line)), (
        "a bus that has passed counts"
    )
    assert not meeting.car_is_swept((enter_m + 1.0, far)), (
        "a car that can stop before the area counts as swept"
    )
    assert not meeting.car_is_swept((enter_m - 5.0, at_line)), "a standing bus counts"
    meeting.rows["speed"][0] = 6.0
    assert meeting.car_is_swept((enter_m - 5.0, at_line)), (
        "a bus that would have to brake hard does not count"
    )
    assert not meeting.car_is_swept((enter_m - 15.0, at_line))
    meeting.rows["speed"] = 6.0, 4.0
    assert meeting.car_is_swept((enter_m + 1.0, far)), (
        "a car that cannot stop before the area is not swept"
    )


def test_no_vehicle_touches_a_turning_bus(path: Path, tmp_path: Path) -> None:
    routes = tmp_path / "crowd.rou.xml"
    routes.write_text(CROWD, encoding="utf-8")
    world = make(path, [routes], overrides={"horizon_s": 200.0, **CLOCK})
    start(world, 1)
    touched = set()
    for _ in range(360):
        drive(world)
        rows = world.vehicles()
        touched |= set(rows["id"][rows["hit"] >= 0].tolist())
    stats = world.traffic_stats()
    assert not touched
    assert stats.arrived > 40


def test_a_vehicle_that_has_to_change_lanes_stops_behind_a_rear_over_the_lane_end(
    network: RoadNetwork,
) -> None:
    """The rear of a bus is on the lane, so a follower stops behind it, wherever the bus turns."""
    link = int(np.flatnonzero(network.links["num_sweeps"] > 0)[0])
    lane = int(network.links[link]["from_lane"])
    length_m = float(network.lanes[lane]["length_m"])
    rows = on_lane(network, lane, length_m - 20.0, id=1, speed=5.0, length=CAR_M)
    room = scratch(network, 2)
    entry = np.zeros(1, APPROACH)
    entry["link"], entry["row"], entry["id"], entry["half"] = link, 1, 2, 0.5 * BUS_M
    entry["dist"] = -1.0
    room.approach[0] = entry[0]
    room.link_start[link], room.link_end[link] = 0, 1
    kind = generated_types()[0]
    constraint = behind_fork(network.arrays, kind, rows[0], lane, -1, 20.0, 0.1, room)
    assert constraint == behind(kind, 5.0, 20.0 + 1.0 - 2.5 - 6.0, 0.0, kind["decel"])
    room.approach[0]["dist"] = -0.5 * BUS_M - 40.0  # the rear of the bus has left the lane
    constraint = behind_fork(network.arrays, kind, rows[0], lane, -1, 20.0, 0.1, room)
    assert constraint == no_constraint(kind)
