"""Registration of approaching vehicles at links, and registered vehicles that are ignored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.records.codes import (
    DRIVER_BACKGROUND,
    HOLD_EXIT_BLOCKED,
    HOLD_NONE,
    HOLD_SIGNAL,
    HOLD_YIELD,
    MODEL_KRAUSS,
)
from cavmarl.driving.kernels.drivers import decide
from cavmarl.driving.kernels.junctions.approach import register_links
from cavmarl.driving.kernels.junctions.stop_line_registration import (
    can_be_ignored,
    registration_distance_m,
)
from cavmarl.driving.kernels.lanes.lane_index import index_lanes
from cavmarl.driving.vehicle_types import generated_types
from cavmarl.roads.routing import PLAN
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.builders import vehicles
from tests.support.junction_scenes import build_crossing
from tests.support.traffic import on_lane, scratch, travel_by


@pytest.mark.parametrize(("speed", "expected"), [(0.0, 30.0), (5.0, 70.0), (20.0, 150.0)])
def test_the_registration_distance_grows_with_speed(speed: float, expected: float) -> None:
    assert registration_distance_m(speed) == expected


@pytest.mark.parametrize(
    ("hold", "wait_s", "speed", "expected"),
    [
        (HOLD_SIGNAL, 0.0, 0.0, True),
        (HOLD_SIGNAL, 0.0, 0.6, False),
        (HOLD_EXIT_BLOCKED, 0.0, 0.5, True),
        (HOLD_YIELD, 60.0, 0.0, False),
        (HOLD_NONE, 3.0, 0.0, False),
        (HOLD_NONE, 3.1, 0.0, True),
        (HOLD_NONE, 3.1, 0.6, False),
    ],
)
def test_a_vehicle_that_stands_at_a_signal_or_without_a_reason_is_ignored(
    hold: int, wait_s: float, speed: float, expected: bool
) -> None:
    (row,) = vehicles([(0.0, 0.0, 0.0)], hold=hold, wait_s=wait_s, speed=speed)
    assert can_be_ignored(row) == expected


@pytest.mark.parametrize("turn", ["s", "r"])
@pytest.mark.parametrize(("more_m", "hold"), [(-0.1, HOLD_EXIT_BLOCKED), (0.2, HOLD_YIELD)])
def test_a_vehicle_without_room_behind_a_standing_leader_does_not_count_as_yielding(
    tmp_path: Path, more_m: float, hold: int, turn: str
) -> None:
    """The gap to the leader beyond the line is slightly below or above the driver's minimum gap.

    The leader takes the same link as the vehicle (`turn` = "s") or another link.
    """
    roads = read_network(build_crossing(tmp_path, "priority"))
    ways = [
        next(k for k, link in enumerate(roads.links)
             if link["from_lane"] == roads.lane_ids.index(lane) and chr(link["direction"]) == way)
        for lane, way in (("S_in_0", "s"), ("W_in_0", "s"), ("S_in_0", turn))
    ]  # fmt: skip
    plan = np.zeros(len(roads.lanes), PLAN)
    plan["next"] = -1
    for way in ways[:2]:
        lane = roads.links["from_lane"][way]
        plan["next"][lane], plan["link"][lane] = roads.links["next_lane"][way], way
    tables = travel_by(plan, generated_types(MODEL_KRAUSS))
    (side, main), inside = roads.links["from_lane"][ways[:2]], roads.links["next_lane"][ways[2]]
    ends_m = roads.lanes["length_m"][[side, main]]
    gap_m = float(tables.types["min_gap"][0])
    place_m = float(ends_m[0]) - 2.5 - 0.2
    rows = np.concatenate(
        [on_lane(roads, int(side), place_m, tables, id=0, driver=DRIVER_BACKGROUND),
         on_lane(roads, int(main), float(ends_m[1]) - 20.0, tables, id=1, speed=14.0),
         on_lane(roads, int(inside), gap_m + more_m + 2.5 - 0.2, tables, id=2)]
    )  # fmt: skip
    room, step = scratch(roads, 3), np.zeros(3, PLAN)
    index_lanes(roads.arrays, tables, rows, 3, room)
    register_links(roads.arrays, tables, rows, 3, step, np.zeros(3, np.int64), room)
    phase = np.zeros(0, np.int32)
    decide(roads.arrays, tables, rows, 3, DRIVER_BACKGROUND, 0, 0.1, phase, step, room)
    assert room.hold[0] == hold
