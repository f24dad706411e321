"""Gap acceptance at junctions: which gaps a driver accepts before and after a foe.

A foe is a vehicle whose path over the junction conflicts with that of the driver.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.records.arrays import TripTables
from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    HOLD_EXIT_BLOCKED,
    HOLD_NONE,
    HOLD_YIELD,
    MODEL_IDM,
    MODEL_KRAUSS,
    SIGNAL_NONE,
    SIGNAL_OFF_BLINKING,
)
from cavmarl.driving.kernels.junctions.approach import APPROACH
from cavmarl.driving.kernels.junctions.gaps import STUCK_S, hold_for_foe, may_ignore
from cavmarl.driving.vehicle_types import generated_types
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.builders import vehicles
from tests.support.crossing import crossing
from tests.support.traffic import on_lane, travel

__all__ = ["crossing"]

SPEED_MPS = 10.0  # speed of both vehicles, and the speed limit
HALF_M = 2.5
FROM_WEST, FROM_SOUTH = 0, 1  # rows of the links

CARS = travel("merge")
Blocks = Callable[..., int]
ALLWAY_STOP, EQUAL, MINOR, STOP = map(ord, "w=ms")


@pytest.fixture
def network(crossing: Callable[..., Path]) -> RoadNetwork:
    return read_network(crossing())


@pytest.fixture
def blocks(network: RoadNetwork) -> Blocks:
    """Return a function that tells how a foe from the west blocks a yielding car from the south."""
    link = network.links[FROM_SOUTH]
    first = int(link["first_conflict"])
    conflicts = network.conflicts[first : first + int(link["num_conflicts"])]
    (shared,) = conflicts[conflicts["foe"] == FROM_WEST]
    row = on_lane(network, network.lane_ids.index("s_0"), 0.0, speed=SPEED_MPS, length=2.0 * HALF_M)

    def ask(
        own_s: float,
        end: str,
        foe_m: float,
        wait_s: float = 0.0,
        own: dict[str, float] | None = None,
        near: bool = True,
        travel: TripTables = CARS,
        **foe_fields: float,
    ) -> int:
        """Return HOLD_NONE if the foe does not block, or the reason to stop.

        Args:
            own_s: Time until the ego car is at `end`.
            end: "enter": its front enters the shared area; "line": its front is at its line; "out":
                its rear leaves the junction.
            foe_m: Distance of the foe's front to its line. If negative, the foe is on the junction,
                and -foe_m is the distance of its rear to the end of the shared area.
            wait_s: Waiting time of both cars.
            own: Fields of the ego car's row of VEHICLE.
            near: Whether the paths come close in the shared area.
            travel: Tables with the vehicle types.
            foe_fields: Fields of the foe's row of VEHICLE.
        """
        foe, asked = np.zeros(1, APPROACH), np.array([shared])
        foe["link"], foe["row"], foe["half"] = FROM_WEST, 1, HALF_M
        asked["near"] = near
        inside = foe_m < 0.0
        foe["dist"] = -shared["foe_leave_m"] - HALF_M - foe_m if inside else foe_m + HALF_M
        ahead = {"enter": shared["enter_m"] - HALF_M, "line": -HALF_M}
        ahead["out"] = link["length_m"] + HALF_M
        row["wait_s"] = wait_s
        rows = np.concatenate([row, row])
        for k, fields in enumerate((own or {}, foe_fields)):
            for name, value in fields.items():
                rows[k][name] = value
        foe["speed"] = rows[1]["speed"]
        return hold_for_foe(
            network.arrays, travel, rows, rows[0], FROM_SOUTH,
            own_s * SPEED_MPS - float(ahead[end]), SPEED_MPS, asked[0], foe[0], True,
            np.zeros(1, np.int32),
        )  # fmt: skip

    return ask


@pytest.mark.parametrize(("driver", "behind_s"), [(DRIVER_BACKGROUND, 0.0), (DRIVER_AGENT, 0.5)])
def test_a_moving_vehicle_may_enter_an_area_as_soon_as_the_foe_has_left_it(
    blocks: Blocks, driver: int, behind_s: float
) -> None:
    # The foe's rear leaves the shared area in 0.6 s.
    assert blocks(0.55 + behind_s, "enter", -6.0, driver=driver)
    assert not blocks(0.65 + behind_s, "enter", -6.0, driver=driver)


@pytest.mark.parametrize(("accel", "waits"), [(0.0, False), (-1.7, False), (-1.9, True)])
def test_a_foe_that_brakes_on_the_junction_is_not_assumed_to_accelerate(
    blocks: Blocks, accel: float, waits: bool
) -> None:
    """The foe leaves the area after 6 m: in 1 s at constant 6 m/s, sooner if it accelerates."""
    blocked = blocks(0.93, "enter", -6.0, own={"speed": SPEED_MPS}, speed=6.0, accel=accel)
    assert blocked == (HOLD_YIELD if waits else HOLD_NONE)


@pytest.mark.parametrize(("accel", "waits"), [(-2.9, False), (-3.1, True)])
def test_a_foe_that_stops_on_the_junction_blocks_distant_vehicles(
    blocks: Blocks, accel: float, waits: bool
) -> None:
    """The foe leaves the area after 6 m. Its braking distance is 6.2 m or 5.8 m."""
    blocked = blocks(9.0, "enter", -6.0, own={"speed": SPEED_MPS}, speed=6.0, accel=accel)
    assert blocked == (HOLD_YIELD if waits else HOLD_NONE)


@pytest.mark.parametrize(
    ("out_s", "hold", "waits"),
    [(0.6, HOLD_YIELD, True), (0.4, HOLD_YIELD, False), (0.6, HOLD_NONE, False)],
)
def test_a_standing_vehicle_starts_half_a_second_before_the_area_is_clear(
    blocks: Blocks, out_s: float, hold: int, waits: bool
) -> None:
    # The vehicle is over one second away from the area. With HOLD_NONE, it has been given its turn,
    # so it does not stop.
    own = {"speed": 0.0, "hold": hold, "stopped_at": FROM_SOUTH}
    assert blocks(0.2, "line", -out_s * SPEED_MPS, 2.0, own) == (HOLD_YIELD if waits else HOLD_NONE)


@pytest.mark.parametrize(
    ("speed", "wait_s", "foe_hold", "hold"),
    [
        (SPEED_MPS, 0.0, HOLD_NONE, HOLD_NONE),  # the foe will have left by then
        (
            SPEED_MPS,
            0.0,
            HOLD_EXIT_BLOCKED,
            HOLD_EXIT_BLOCKED,
        ),  # another vehicle blocks the foe
        (0.0, 2.9, HOLD_NONE, HOLD_YIELD),  # the foe may start at any time
        (0.0, 3.1, HOLD_NONE, HOLD_EXIT_BLOCKED),
    ],
)
def test_a_foe_that_stays_on_the_junction_blocks_others(
    blocks: Blocks, speed: float, wait_s: float, foe_hold: int, hold: int
) -> None:
    assert blocks(9.0, "enter", -3.0, speed=speed, wait_s=wait_s, hold=foe_hold) == hold
    assert blocks(9.0, "enter", -40.0, speed=0.0, wait_s=9.0) == HOLD_NONE, (
        "a foe that stands before the area blocks"
    )


def test_a_foe_whose_path_is_not_near_blocks_only_before_its_line(
    blocks: Blocks, network: RoadNetwork
) -> None:
    assert blocks(0.2, "enter", -6.0)
    assert blocks(0.2, "line", 20.0)
    assert not blocks(0.2, "enter", -6.0, near=False)
    assert blocks(0.2, "line", 20.0, near=False), (
        "a foe before its line does not block despite its right of way"
    )


def test_an_approaching_foe_blocks_until_its_rear_has_left_the_junction(
    blocks: Blocks, network: RoadNetwork
) -> None:
    # The front is 20 m before its line, and the rear is 5 m behind the front.
    over_s = (25.0 + float(network.links["length_m"][FROM_WEST])) / SPEED_MPS
    assert blocks(over_s - 0.05, "line", 20.0)
    assert not blocks(over_s + 0.05, "line", 20.0)


@pytest.mark.parametrize(("driver", "ahead_s"), [(DRIVER_BACKGROUND, 1.0), (DRIVER_AGENT, 3.0)])
def test_the_time_gap_is_one_second_or_three_seconds_if_a_car_is_an_agent(
    blocks: Blocks, driver: int, ahead_s: float
) -> None:
    # The foe's front reaches its line in 5 s.
    assert blocks(5.05 - ahead_s, "out", 50.0, driver=driver)
    assert not blocks(4.95 - ahead_s, "out", 50.0, driver=driver)


@pytest.mark.parametrize(("to_go_m", "waits"), [(52.4, False), (60.0, True), (0.0, True)])
def test_a_foe_whose_trip_ends_before_its_line_is_ignored(
    blocks: Blocks, to_go_m: float, waits: bool
) -> None:
    """The foe's centre is 52.5 m before its line. `to_go` is 0 if its goal is unknown."""
    assert bool(blocks(4.5, "out", 50.0, to_go=to_go_m)) == waits


def test_a_foe_that_accelerates_arrives_earlier(blocks: Blocks) -> None:
    # From 4 m/s with 2 m/s², the foe reaches the limit of 10 m/s after 21 m, and 50 m in 5.9 s.
    assert blocks(4.95, "out", 50.0, speed=4.0, accel=2.0)
    assert not blocks(4.85, "out", 50.0, speed=4.0, accel=2.0)
    assert not blocks(4.95, "out", 50.0, speed=4.0), (
        "a foe at constant 4 m/s, which needs 12.5 s, blocks"
    )


@pytest.mark.parametrize("wait_s", [0.0, 90.0, 180.0, 900.0])
def test_a_crossing_driver_never_expects_foes_to_brake(
    blocks: Blocks, network: RoadNetwork, wait_s: float
) -> None:
    over_s = (float(network.links["length_m"][FROM_SOUTH]) + 2.0 * HALF_M) / SPEED_MPS
    assert over_s == 1.5, "the path over the junction is not 10 m long"
    # The ego car has left the junction after 1.5 s, and the time gap is 1.0 s.
    assert blocks(over_s, "out", 24.8, wait_s)
    assert not blocks(over_s, "out", 25.2, wait_s)


@pytest.mark.parametrize("accel", [1.2, 2.5, 5.0])
def test_a_vehicle_that_accelerates_slowly_needs_a_longer_gap(
    blocks: Blocks, network: RoadNetwork, accel: float
) -> None:
    """The car starts with at most 2.5 m/s². The time gap is 1 s."""
    types = CARS.types.copy()
    types["accel"] = accel
    length_m = float(network.links["length_m"][FROM_SOUTH])
    leaves_mps = np.sqrt(2.0 * min(accel, 2.5) * length_m)
    out_s = 2.0 * (length_m + 2.0 * HALF_M) / leaves_mps
    asked = partial(blocks, 0.0, "line", own={"speed": 0.0}, travel=CARS._replace(types=types))
    assert asked((out_s + 0.95) * SPEED_MPS)
    assert not asked((out_s + 1.05) * SPEED_MPS)


def test_a_vehicle_that_stands_a_metre_before_its_line_needs_no_longer_gap(blocks: Blocks) -> None:
    """Driving this metre takes 1.05 s at 1.8 m/s², so counting it would make the gap too long."""
    own = {"speed": 0.0}
    at_line = next(m for m in np.arange(1.0, 99.0, 0.1) if not blocks(0.0, "line", m, own=own))
    before = next(m for m in np.arange(1.0, 99.0, 0.1) if not blocks(0.1, "line", m, own=own))
    assert before == at_line
    later = next(m for m in np.arange(1.0, 99.0, 0.1) if not blocks(0.2, "line", m, own=own))
    assert later > at_line + 8.0


def least_ahead(network: RoadNetwork, driver: int, wait_s: float, foe_mps: float) -> Any:
    """Return the smallest accepted distance of a merging foe to its line, and the driven distance.

    Both are in m. The ego vehicle drives at its limit of 5 m/s, with its front 2.5 m before its
    line. The driven distance ends when its rear has left the junction.
    """
    own = np.repeat(np.arange(len(network.links)), network.links["num_conflicts"])
    shared = next(k for k in np.flatnonzero(network.conflicts["merging"])
                  if network.conflicts["must_yield"][k])  # fmt: skip
    conflict, link = network.conflicts[shared], int(own[shared])
    rows = np.concatenate([on_lane(network, 0, 0.0, speed=5.0, driver=driver)] * 2)
    rows["speed"][1], rows["wait_s"][0] = foe_mps, wait_s
    foe = np.zeros(1, APPROACH)
    foe["link"], foe["row"], foe["half"], foe["speed"] = conflict["foe"], 1, HALF_M, foe_mps
    length_m = float(rows["length"][0])
    over_m = 5.0 + 0.5 * length_m + float(network.links["length_m"][link])
    assert conflict["enter_m"] > network.links["wait_m"][link] - 1.0, (
        "the shared area begins well before the waiting position"
    )

    def waits(front_m: float) -> int:
        foe["dist"] = front_m + HALF_M
        return hold_for_foe(network.arrays, CARS, rows, rows[0], link, 5.0, 5.0, conflict, foe[0],
                          True, np.zeros(1, np.int32))  # fmt: skip

    return next(m for m in np.arange(1.0, 400.0, 0.1) if not waits(m)), over_m


@pytest.mark.parametrize(
    ("driver", "foe_mps", "ahead_s"),
    [
        (DRIVER_BACKGROUND, 4.0, 1.0),
        (DRIVER_BACKGROUND, 10.0, 1.0),
        (DRIVER_AGENT, 4.0, 1.5),
        (DRIVER_AGENT, 10.0, 1.5),
        (DRIVER_AGENT, 30.0, 2.3),  # (30 - 5)² / (2 · 4.5 · 30): time to brake behind it
    ],
)
def test_a_vehicle_merges_before_a_foe_that_can_brake(
    network: RoadNetwork, driver: int, foe_mps: float, ahead_s: float
) -> None:
    least_m, over_m = least_ahead(network, driver, 0.0, foe_mps)
    assert least_m / foe_mps == pytest.approx(over_m / 5.0 + ahead_s, abs=0.1)


@pytest.mark.parametrize(("wait_s", "brakes_m"), [(15.0, 100.0), (20.0, 75.0)])
def test_a_driver_that_has_waited_merges_before_a_foe_that_brakes_gently(
    network: RoadNetwork, wait_s: float, brakes_m: float
) -> None:
    # The foe may have to brake from 10 to 5 m/s with 4.5 m/s² · waiting time / 180 s. It begins
    # to brake in 0.3 s, when the ego vehicle is 1 m before its line.
    least_m, _ = least_ahead(network, DRIVER_BACKGROUND, wait_s, 10.0)
    assert least_m == pytest.approx(brakes_m + 0.3 * 10.0, abs=0.1)


def waiting_pair(**fields: Any) -> Any:
    """Return two vehicles that yield; the second one, the foe, has stopped at link 1."""
    return vehicles([(0.0, 0.0, 0.0)] * 2, hold=HOLD_YIELD, stopped_at=[-1, 1], **fields)


@pytest.mark.parametrize(
    ("own_wait_s", "foe_wait_s", "own_id", "speed", "goes"),
    [
        (0.6, 0.2, 5, 0.0, True),
        (0.4, 0.2, 5, 0.0, False),  # the vehicle has stood for less than half a second
        (0.6, 0.7, 0, 0.0, False),
        (0.6, 0.6, 0, 0.0, True),
        (0.6, 0.6, 5, 0.0, False),
        (0.6, 0.2, 5, 1.0, False),  # the vehicle moves
    ],
)
def test_at_an_all_way_stop_the_longest_waiting_vehicle_goes_first(
    own_wait_s: float, foe_wait_s: float, own_id: int, speed: float, goes: bool
) -> None:
    waits = [own_wait_s, foe_wait_s]
    row, foe = waiting_pair(id=[own_id, 3], wait_s=waits, speed=[speed, 0.0])
    assert may_ignore(row, foe, 0, 1, SIGNAL_NONE, ALLWAY_STOP, ALLWAY_STOP, STUCK_S) == goes


@pytest.mark.parametrize(("stopped_at", "goes"), [(1, False), (-1, True)])
def test_at_an_all_way_stop_a_foe_that_has_not_stopped_is_ignored(
    stopped_at: int, goes: bool
) -> None:
    row, foe = vehicles(
        [(0.0, 0.0, 0.0)] * 2, speed=[0.0, 8.0], wait_s=[0.6, 0.0], stopped_at=[0, stopped_at]
    )
    assert may_ignore(row, foe, 0, 1, SIGNAL_NONE, ALLWAY_STOP, ALLWAY_STOP, STUCK_S) == goes
    assert not may_ignore(row, foe, 0, 1, SIGNAL_NONE, STOP, STOP, STUCK_S), (
        "at a stop sign of a side road, the foe is ignored"
    )


def test_a_vehicle_on_equal_roads_ignores_a_waiting_foe_after_three_seconds() -> None:
    row, foe = waiting_pair(id=[5, 3], wait_s=[3.1, 9.0], speed=0.0)
    assert may_ignore(row, foe, 0, 1, SIGNAL_NONE, EQUAL, EQUAL, STUCK_S)
    row["wait_s"] = 2.9
    assert not may_ignore(row, foe, 0, 1, SIGNAL_NONE, EQUAL, EQUAL, STUCK_S), (
        "a foe that has waited longer is ignored too early"
    )


@pytest.mark.parametrize(
    ("model", "driver", "most_s"),
    [
        (MODEL_KRAUSS, DRIVER_BACKGROUND, 300.0),
        (MODEL_KRAUSS, DRIVER_AGENT, 90.0),
        (MODEL_IDM, DRIVER_BACKGROUND, 90.0),
    ],
)
@pytest.mark.parametrize(("later_s", "goes"), [(-1.0, False), (1.0, True)])
def test_a_driver_gives_way_to_a_waiting_foe_for_a_limited_time(
    blocks: Blocks, model: int, driver: int, most_s: float, later_s: float, goes: bool
) -> None:
    """Background drivers with Krauss's model wait 300 s, as in SUMO; other drivers wait 90 s."""
    cars = CARS._replace(types=generated_types(model))
    own = {"wait_s": most_s + later_s, "hold": HOLD_YIELD, "stopped_at": -1, "driver": driver}
    foe = {"speed": 0.0, "wait_s": 9.0, "hold": HOLD_YIELD, "stopped_at": FROM_WEST}
    asked = blocks(0.0, "line", 0.5, own={"speed": 0.0, **own}, travel=cars, **foe)
    assert (asked == HOLD_NONE) == goes


@pytest.mark.parametrize(
    ("own_wait_s", "foe_hold", "goes"),
    [(9.0, HOLD_YIELD, True), (1.0, HOLD_YIELD, False), (9.0, HOLD_NONE, False)],
)
def test_at_blinking_signals_the_longest_waiting_vehicle_goes_first(
    own_wait_s: float, foe_hold: int, goes: bool
) -> None:
    row, foe = waiting_pair(id=[5, 3], wait_s=[own_wait_s, 2.0], speed=0.0)
    foe["hold"] = foe_hold  # HOLD_NONE means that the foe is about to start
    assert may_ignore(row, foe, 0, 1, SIGNAL_OFF_BLINKING, MINOR, MINOR, STUCK_S) == goes


@pytest.mark.parametrize(("stopped_at", "goes"), [(1, True), (2, False)])
def test_an_agent_that_stands_at_its_stop_line_is_assumed_to_yield(
    stopped_at: int, goes: bool
) -> None:
    row, foe = vehicles(
        [(0.0, 0.0, 0.0)] * 2,
        id=[5, 3],
        wait_s=[0.6, 0.2],
        speed=0.0,
        driver=[DRIVER_BACKGROUND, DRIVER_AGENT],
        stopped_at=[-1, stopped_at],
    )
    assert may_ignore(row, foe, 0, 1, SIGNAL_NONE, ALLWAY_STOP, STOP, STUCK_S) == goes
