"""Which gaps a driver accepts at a junction, by its limits in seconds."""

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
from cavmarl.driving.kernels.junctions.gaps import STUCK_S, foe_blocks, ignores
from cavmarl.driving.vehicle_types import generated_types
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.builders import vehicles
from tests.support.crossing import crossing
from tests.support.traffic import on_lane, travel

__all__ = ["crossing"]

SPEED_MPS = 10.0  # of both, all along: it is the limit
HALF_M = 2.5
FROM_WEST, FROM_SOUTH = 0, 1  # LINK rows

CARS = travel("merge")
Blocks = Callable[..., int]
ALLWAY_STOP, EQUAL, MINOR, STOP = map(ord, "w=ms")


@pytest.fixture
def network(crossing: Callable[..., Path]) -> RoadNetwork:
    return read_network(crossing())


@pytest.fixture
def blocks(network: RoadNetwork) -> Blocks:
    """Whether a car from the west blocks one from the south, which gives way to it (HOLD_*)."""
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
        """By how long and how far they are before what they share.

        `own_s`: until the own front enters the shared area or is at its `line`, or the own rear is
        `out` of the junction, as `end` says. `foe_m`: of the other one's front to its line;
        negative: of its rear to the end of the shared area. `own`, `foe_fields`: of their records.
        """
        foe, asked = np.zeros(1, APPROACH), np.array([shared])
        foe["link"], foe["row"], foe["half"] = FROM_WEST, 1, HALF_M
        asked["near"] = near
        inside = foe_m < 0.0
        foe["dist"] = -shared["foe_leave_m"] - HALF_M - foe_m if inside else foe_m + HALF_M
        ahead = {"enter": shared["enter_m"] - HALF_M, "line": -HALF_M}
        ahead["out"] = link["length_m"] + HALF_M
        row["wait_s"] = wait_s  # of both
        rows = np.concatenate([row, row])
        for k, fields in enumerate((own or {}, foe_fields)):
            for name, value in fields.items():
                rows[k][name] = value
        foe["speed"] = rows[1]["speed"]
        return foe_blocks(
            network.arrays, travel, rows, rows[0], FROM_SOUTH,
            own_s * SPEED_MPS - float(ahead[end]), SPEED_MPS, asked[0], foe[0], True,
            np.zeros(1, np.int32),
        )  # fmt: skip

    return ask


@pytest.mark.parametrize(("driver", "behind_s"), [(DRIVER_BACKGROUND, 0.0), (DRIVER_AGENT, 0.5)])
def test_one_that_comes_enters_where_another_is_just_out(
    blocks: Blocks, driver: int, behind_s: float
) -> None:
    # Its rear leaves the shared area in 0.6 s.
    assert blocks(0.55 + behind_s, "enter", -6.0, driver=driver)
    assert not blocks(0.65 + behind_s, "enter", -6.0, driver=driver)


@pytest.mark.parametrize(("accel", "waits"), [(0.0, False), (-1.7, False), (-1.9, True)])
def test_one_that_brakes_on_the_junction_does_not_speed_up(
    blocks: Blocks, accel: float, waits: bool
) -> None:
    """Its rear has 6 m to go: 0.6 s, or 1 s at the 6 m/s to which it has slowed down."""
    blocked = blocks(0.93, "enter", -6.0, own={"speed": SPEED_MPS}, speed=6.0, accel=accel)
    assert blocked == (HOLD_YIELD if waits else HOLD_NONE)


@pytest.mark.parametrize(("accel", "waits"), [(-2.9, False), (-3.1, True)])
def test_one_that_brakes_to_a_stop_on_the_junction_is_waited_for_from_afar(
    blocks: Blocks, accel: float, waits: bool
) -> None:
    """Its rear has 6 m to go; it stops within 6.2 m, or 5.8."""
    blocked = blocks(9.0, "enter", -6.0, own={"speed": SPEED_MPS}, speed=6.0, accel=accel)
    assert blocked == (HOLD_YIELD if waits else HOLD_NONE)


@pytest.mark.parametrize(
    ("out_s", "hold", "waits"),
    [(0.6, HOLD_YIELD, True), (0.4, HOLD_YIELD, False), (0.6, HOLD_NONE, False)],
)
def test_one_that_stands_sets_off_half_a_second_before_another_is_out(
    blocks: Blocks, out_s: float, hold: int, waits: bool
) -> None:
    # It needs over a second to where the other one is. One that has set off goes on.
    own = {"speed": 0.0, "hold": hold, "stopped_at": FROM_SOUTH}
    assert blocks(0.2, "line", -out_s * SPEED_MPS, 2.0, own) == (HOLD_YIELD if waits else HOLD_NONE)


@pytest.mark.parametrize(
    ("speed", "wait_s", "foe_hold", "hold"),
    [
        (SPEED_MPS, 0.0, HOLD_NONE, HOLD_NONE),  # it will have left
        (SPEED_MPS, 0.0, HOLD_EXIT_BLOCKED, HOLD_EXIT_BLOCKED),  # another one keeps it there
        (0.0, 2.9, HOLD_NONE, HOLD_YIELD),  # it may go on at once
        (0.0, 3.1, HOLD_NONE, HOLD_EXIT_BLOCKED),
    ],
)
def test_one_that_stays_on_the_junction_keeps_others_before_it(
    blocks: Blocks, speed: float, wait_s: float, foe_hold: int, hold: int
) -> None:
    assert blocks(9.0, "enter", -3.0, speed=speed, wait_s=wait_s, hold=foe_hold) == hold
    assert blocks(9.0, "enter", -40.0, speed=0.0, wait_s=9.0) == HOLD_NONE, "it stands before it"


def test_one_on_a_path_that_keeps_apart_counts_before_its_line_only(
    blocks: Blocks, network: RoadNetwork
) -> None:
    assert blocks(0.2, "enter", -6.0)
    assert blocks(0.2, "line", 20.0)
    assert not blocks(0.2, "enter", -6.0, near=False)
    assert blocks(0.2, "line", 20.0, near=False), "the map says that it gives way"


def test_one_that_comes_is_let_over_the_whole_junction(
    blocks: Blocks, network: RoadNetwork
) -> None:
    # Its front has 20 m to its line, and its rear 5 m more to the end of its way over.
    over_s = (25.0 + float(network.links["length_m"][FROM_WEST])) / SPEED_MPS
    assert blocks(over_s - 0.05, "line", 20.0)
    assert not blocks(over_s + 0.05, "line", 20.0)


@pytest.mark.parametrize(("driver", "ahead_s"), [(DRIVER_BACKGROUND, 1.0), (DRIVER_AGENT, 3.0)])
def test_before_one_that_comes_to_its_line_it_is_over_one_second_earlier_or_if_steered_three(
    blocks: Blocks, driver: int, ahead_s: float
) -> None:
    # Its front reaches its line in 5 s.
    assert blocks(5.05 - ahead_s, "out", 50.0, driver=driver)
    assert not blocks(4.95 - ahead_s, "out", 50.0, driver=driver)


@pytest.mark.parametrize(("to_go_m", "waits"), [(52.4, False), (60.0, True), (0.0, True)])
def test_one_whose_trip_ends_before_its_line_is_not_waited_for(
    blocks: Blocks, to_go_m: float, waits: bool
) -> None:
    """Its centre has 52.5 m to its line; 0 says a row that knows no end of its way."""
    assert bool(blocks(4.5, "out", 50.0, to_go=to_go_m)) == waits


def test_one_that_speeds_up_comes_earlier(blocks: Blocks) -> None:
    # From 4 m/s with 2 m/s² it has 10 m/s, the limit, after 3 s and 21 m, and 50 m after 5.9 s.
    assert blocks(4.95, "out", 50.0, speed=4.0, accel=2.0)
    assert not blocks(4.85, "out", 50.0, speed=4.0, accel=2.0)
    assert not blocks(4.95, "out", 50.0, speed=4.0), "at the speed that it has it takes 12.5 s"


@pytest.mark.parametrize("wait_s", [0.0, 90.0, 180.0, 900.0])
def test_one_that_crosses_does_not_count_on_others_to_brake_however_long_it_has_waited(
    blocks: Blocks, network: RoadNetwork, wait_s: float
) -> None:
    over_s = (float(network.links["length_m"][FROM_SOUTH]) + 2.0 * HALF_M) / SPEED_MPS
    assert over_s == 1.5, "its front is at its line"
    # Out in 1.5 s, with 1.0 s more.
    assert blocks(over_s, "out", 24.8, wait_s)
    assert not blocks(over_s, "out", 25.2, wait_s)


@pytest.mark.parametrize("accel", [1.2, 2.5, 5.0])
def test_one_that_speeds_up_slowly_needs_a_longer_gap(
    blocks: Blocks, network: RoadNetwork, accel: float
) -> None:
    """Out of the junction from a stand, with 2.5 m/s² at most, and 1 s more."""
    types = CARS.types.copy()
    types["accel"] = accel
    length_m = float(network.links["length_m"][FROM_SOUTH])
    leaves_mps = np.sqrt(2.0 * min(accel, 2.5) * length_m)
    out_s = 2.0 * (length_m + 2.0 * HALF_M) / leaves_mps
    asked = partial(blocks, 0.0, "line", own={"speed": 0.0}, travel=CARS._replace(types=types))
    assert asked((out_s + 0.95) * SPEED_MPS)
    assert not asked((out_s + 1.05) * SPEED_MPS)


def test_one_that_stands_before_its_line_counts_as_one_at_it(blocks: Blocks) -> None:
    """With 1.8 m/s² it needs 1.05 s for a metre, and without that it would be out too late."""
    own = {"speed": 0.0}
    at_line = next(m for m in np.arange(1.0, 99.0, 0.1) if not blocks(0.0, "line", m, own=own))
    before = next(m for m in np.arange(1.0, 99.0, 0.1) if not blocks(0.1, "line", m, own=own))
    assert before == at_line
    later = next(m for m in np.arange(1.0, 99.0, 0.1) if not blocks(0.2, "line", m, own=own))
    assert later > at_line + 8.0


def least_ahead(network: RoadNetwork, driver: int, wait_s: float, foe_mps: float) -> Any:
    """Of one that comes into the same lane: the least way to its line, and the own one over, in m.

    The other one has 5 m/s, its front 2.5 m to its line, and drives no faster.
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
    assert conflict["enter_m"] > network.links["wait_m"][link] - 1.0, "it is asked about inside"

    def waits(front_m: float) -> int:
        foe["dist"] = front_m + HALF_M
        return foe_blocks(network.arrays, CARS, rows, rows[0], link, 5.0, 5.0, conflict, foe[0],
                          True, np.zeros(1, np.int32))  # fmt: skip

    return next(m for m in np.arange(1.0, 400.0, 0.1) if not waits(m)), over_m


@pytest.mark.parametrize(
    ("driver", "foe_mps", "ahead_s"),
    [
        (DRIVER_BACKGROUND, 4.0, 1.0),
        (DRIVER_BACKGROUND, 10.0, 1.0),
        (DRIVER_AGENT, 4.0, 1.5),
        (DRIVER_AGENT, 10.0, 1.5),
        (DRIVER_AGENT, 30.0, 2.3),  # (30 - 5)² / (2 · 4.5 · 30): the way to brake behind it
    ],
)
def test_before_one_that_comes_into_the_same_lane_it_goes_a_little_earlier(
    network: RoadNetwork, driver: int, foe_mps: float, ahead_s: float
) -> None:
    least_m, over_m = least_ahead(network, driver, 0.0, foe_mps)
    assert least_m / foe_mps == pytest.approx(over_m / 5.0 + ahead_s, abs=0.1)


@pytest.mark.parametrize(("wait_s", "brakes_m"), [(15.0, 100.0), (20.0, 75.0)])
def test_one_that_has_stood_goes_before_a_faster_one_that_need_hardly_brake(
    network: RoadNetwork, wait_s: float, brakes_m: float
) -> None:
    # From 10 to 5 m/s with 4.5 m/s² times the share of 180 s that it has waited: it begins when the
    # other one is 1 m before its line, in 0.3 s.
    least_m, _ = least_ahead(network, DRIVER_BACKGROUND, wait_s, 10.0)
    assert least_m == pytest.approx(brakes_m + 0.3 * 10.0, abs=0.1)


def waiting_pair(**fields: Any) -> Any:
    """One that asks, and its foe at link 1: both stand and give way."""
    return vehicles([(0.0, 0.0, 0.0)] * 2, hold=HOLD_YIELD, stopped_at=[-1, 1], **fields)


@pytest.mark.parametrize(
    ("own_wait_s", "foe_wait_s", "own_id", "speed", "goes"),
    [
        (0.6, 0.2, 5, 0.0, True),
        (0.4, 0.2, 5, 0.0, False),  # it has not stood for half a second
        (0.6, 0.7, 0, 0.0, False),
        (0.6, 0.6, 0, 0.0, True),
        (0.6, 0.6, 5, 0.0, False),
        (0.6, 0.2, 5, 1.0, False),  # it moves
    ],
)
def test_at_an_all_way_stop_the_one_goes_that_has_stood_longer(
    own_wait_s: float, foe_wait_s: float, own_id: int, speed: float, goes: bool
) -> None:
    waits = [own_wait_s, foe_wait_s]
    row, foe = waiting_pair(id=[own_id, 3], wait_s=waits, speed=[speed, 0.0])
    assert ignores(row, foe, 0, 1, SIGNAL_NONE, ALLWAY_STOP, ALLWAY_STOP, STUCK_S) == goes


@pytest.mark.parametrize(("stopped_at", "goes"), [(1, False), (-1, True)])
def test_at_an_all_way_stop_one_that_has_not_stood_yet_is_not_waited_for(
    stopped_at: int, goes: bool
) -> None:
    row, foe = vehicles(
        [(0.0, 0.0, 0.0)] * 2, speed=[0.0, 8.0], wait_s=[0.6, 0.0], stopped_at=[0, stopped_at]
    )
    assert ignores(row, foe, 0, 1, SIGNAL_NONE, ALLWAY_STOP, ALLWAY_STOP, STUCK_S) == goes
    assert not ignores(row, foe, 0, 1, SIGNAL_NONE, STOP, STOP, STUCK_S), (
        "a stop sign of a side road"
    )


def test_equals_that_wait_do_not_stop_one_another() -> None:
    row, foe = waiting_pair(id=[5, 3], wait_s=[3.1, 9.0], speed=0.0)
    assert ignores(row, foe, 0, 1, SIGNAL_NONE, EQUAL, EQUAL, STUCK_S)
    row["wait_s"] = 2.9
    assert not ignores(row, foe, 0, 1, SIGNAL_NONE, EQUAL, EQUAL, STUCK_S), "first the longer one"


@pytest.mark.parametrize(
    ("model", "driver", "most_s"),
    [
        (MODEL_KRAUSS, DRIVER_BACKGROUND, 300.0),
        (MODEL_KRAUSS, DRIVER_AGENT, 90.0),
        (MODEL_IDM, DRIVER_BACKGROUND, 90.0),
    ],
)
@pytest.mark.parametrize(("later_s", "goes"), [(-1.0, False), (1.0, True)])
def test_a_road_comes_first_while_it_waits_itself_but_not_for_ever(
    blocks: Blocks, model: int, driver: int, most_s: float, later_s: float, goes: bool
) -> None:
    """Of drivers as SUMO has them as long as there, of others not so long."""
    cars = CARS._replace(types=generated_types(model))
    own = {"wait_s": most_s + later_s, "hold": HOLD_YIELD, "stopped_at": -1, "driver": driver}
    foe = {"speed": 0.0, "wait_s": 9.0, "hold": HOLD_YIELD, "stopped_at": FROM_WEST}
    asked = blocks(0.0, "line", 0.5, own={"speed": 0.0, **own}, travel=cars, **foe)
    assert (asked == HOLD_NONE) == goes


@pytest.mark.parametrize(
    ("own_wait_s", "foe_hold", "goes"),
    [(9.0, HOLD_YIELD, True), (1.0, HOLD_YIELD, False), (9.0, HOLD_NONE, False)],
)
def test_where_signals_blink_of_two_that_give_way_the_one_goes_that_has_stood_longer(
    own_wait_s: float, foe_hold: int, goes: bool
) -> None:
    row, foe = waiting_pair(id=[5, 3], wait_s=[own_wait_s, 2.0], speed=0.0)
    foe["hold"] = foe_hold  # HOLD_NONE: it is about to go
    assert ignores(row, foe, 0, 1, SIGNAL_OFF_BLINKING, MINOR, MINOR, STUCK_S) == goes


@pytest.mark.parametrize(("stopped_at", "goes"), [(1, True), (2, False)])
def test_an_agent_that_stands_at_its_stop_line_gives_way(stopped_at: int, goes: bool) -> None:
    row, foe = vehicles(
        [(0.0, 0.0, 0.0)] * 2,
        id=[5, 3],
        wait_s=[0.6, 0.2],
        speed=0.0,
        driver=[DRIVER_BACKGROUND, DRIVER_AGENT],
        stopped_at=[-1, stopped_at],
    )
    assert ignores(row, foe, 0, 1, SIGNAL_NONE, ALLWAY_STOP, STOP, STUCK_S) == goes
