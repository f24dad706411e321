"""`locate` finds the lanes of steered vehicles that the tests move on simple maps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.records.arrays import LaneGrid
from cavmarl.core.records.codes import EVENT_OFF_ROAD, EVENT_WRONG_WAY
from cavmarl.driving.kernels.motion.tracking import locate, side_lane
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import lane_grid, make_plans
from tests.support.traffic import NAMES, network, on_lane, plans

GRIDS: dict[str, LaneGrid] = {}


def find(
    name: str, row: NDArray[np.void], table: NDArray[np.void] | None = None
) -> tuple[str, float, float, int]:
    """Call `locate` and return (lane, s, d, events)."""
    roads = network(name)
    grid = GRIDS.setdefault(name, lane_grid(roads))
    events = locate(roads.arrays, plans(name) if table is None else table, grid, row[0])
    return roads.lane_ids[row[0]["lane"]], float(row[0]["s"]), float(row[0]["d"]), events


def shift(row: NDArray[np.void], forward: float, left: float) -> None:
    """Move a vehicle by distances in its own frame, without changing the lane of its row."""
    cos, sin = math.cos(row[0]["heading"]), math.sin(row[0]["heading"])
    row["x"] += forward * cos - left * sin
    row["y"] += forward * sin + left * cos


def lane_of(roads: RoadNetwork, name: str) -> int:
    return roads.lane_ids.index(name)


@given(st.sampled_from(NAMES), st.data())
def test_a_vehicle_on_a_lane_is_located_there(name: str, data: st.DataObject) -> None:
    roads = network(name)
    outside = np.flatnonzero(~roads.lanes["internal"])
    lane = int(data.draw(st.sampled_from(outside.tolist())))
    here = roads.lanes[lane]
    s = data.draw(st.floats(0.5, float(here["length_m"]) - 0.5))
    d = data.draw(st.floats(-0.45, 0.45)) * float(here["width_m"])
    row = on_lane(roads, lane, s, d=d)
    row["s"] += data.draw(st.floats(-3.0, 3.0))  # give `locate` an old position up to 3 m away
    row["d"] = 0.0
    found, found_s, found_d, events = find(name, row)
    # In a bend, the nearest point may be slightly different from the drawn one.
    assert found == roads.lane_ids[lane]
    assert found_s == pytest.approx(s, abs=1.0)
    assert found_d == pytest.approx(d, abs=0.3)
    assert events == 0


def test_a_vehicle_that_is_moved_by_over_half_a_lane_is_on_the_neighbour_lane() -> None:
    roads = network("merge")
    right, left = lane_of(roads, "main_in_0"), lane_of(roads, "main_in_1")
    half = 0.5 * float(roads.lanes[right]["width_m"])
    row = on_lane(roads, right, 50.0)
    shift(row, 0.0, half - 0.01)
    assert find("merge", row)[0] == "main_in_0"
    shift(row, 0.0, 0.02)
    found, s, d, events = find("merge", row)
    assert (found, events) == ("main_in_1", 0)
    assert d == pytest.approx(-half + 0.01)
    assert s == pytest.approx(50.0)
    shift(row, 0.0, -0.02)
    assert find("merge", row)[0] == "main_in_0"
    assert left == roads.lanes[right]["left"]


@pytest.mark.parametrize(("apart_m", "expected"), [(0.01, 0), (0.9, 0), (1.5, EVENT_OFF_ROAD)])
def test_a_narrow_seam_between_neighbour_lanes_counts_as_road(
    apart_m: float, expected: int
) -> None:
    """Bends and rounding leave seams between lanes. A traffic island is wider than a seam."""
    roads = network("merge")
    right, left = (roads.lanes[lane_of(roads, f"main_in_{k}")] for k in (0, 1))
    points = roads.points.copy()
    moved = points[left["first_point"] : left["first_point"] + left["num_points"]]
    moved["x"] -= apart_m * np.sin(moved["heading"])
    moved["y"] += apart_m * np.cos(moved["heading"])
    arrays = replace(roads, points=points).arrays
    row = on_lane(roads, lane_of(roads, "main_in_0"), 50.0)
    shift(row, 0.0, 0.5 * float(right["width_m"]) + 0.5 * apart_m)
    grid = GRIDS.setdefault("merge", lane_grid(roads))
    assert locate(arrays, plans("merge"), grid, row[0]) == expected


def test_a_vehicle_beyond_the_end_of_a_lane_is_on_the_planned_next_lane() -> None:
    roads = network("grid4x4")
    junction_ways = set()
    lane = lane_of(roads, "A1B1_0")
    first = roads.lanes[lane]["first_link"]
    for link in range(first, first + roads.lanes[lane]["num_links"]):
        target = roads.lanes[roads.links[link]["to_lane"]]["edge"]
        table = make_plans(roads, [int(target)])
        row = on_lane(roads, lane, float(roads.lanes[lane]["length_m"]) - 0.2)
        shift(row, 0.5, 0.0)
        found, s, _, events = find("grid4x4", row, table)
        assert roads.lane_ids.index(found) == roads.links[link]["next_lane"]
        assert row[0]["link"] == link
        assert events == 0
        assert 0.0 <= s < 1.0
        junction_ways.add(found)
    assert len(junction_ways) == roads.lanes[lane]["num_links"] > 1


def test_a_vehicle_off_the_road_has_an_event() -> None:
    roads = network("merge")
    row = on_lane(roads, lane_of(roads, "main_in_0"), 100.0)
    shift(row, 0.0, -1.5)
    assert find("merge", row)[3] == 0
    shift(row, 0.0, -2.0)
    assert find("merge", row)[3] == EVENT_OFF_ROAD
    row = on_lane(roads, lane_of(roads, "main_out_0"), 50.0)
    row["x"] += 1e6
    assert find("merge", row)[3] & EVENT_OFF_ROAD


def test_a_vehicle_that_faces_against_its_lane_has_the_event_wrong_way() -> None:
    roads = network("grid4x4")
    lane = lane_of(roads, "A1B1_0")
    row = on_lane(roads, lane, 40.0)
    row["heading"] += math.pi
    assert find("grid4x4", row)[3] == EVENT_WRONG_WAY
    row["heading"] += 0.4 * math.pi
    assert find("grid4x4", row)[3] == EVENT_WRONG_WAY
    row["heading"] += 0.2 * math.pi
    assert find("grid4x4", row)[3] == 0


def test_a_vehicle_on_the_lanes_of_the_other_direction_has_the_event_wrong_way() -> None:
    roads = network("grid4x4")
    outermost = lane_of(roads, "A1B1_1")
    row = on_lane(roads, outermost, 40.0)
    shift(row, 0.0, 3.2)
    found, _, _, events = find("grid4x4", row)
    assert events == EVENT_WRONG_WAY
    # Once it faces the opposite direction, the vehicle is on the correct side.
    row["heading"] += math.pi
    found, _, _, events = find("grid4x4", row)
    assert events == 0
    assert found.startswith("B1A1")


def test_a_vehicle_on_no_lane_is_measured_from_its_last_lane() -> None:
    roads = network("grid4x4")
    row = on_lane(roads, lane_of(roads, "A1B1_0"), 2.0)
    row["heading"] += math.pi
    shift(row, 30.0, 0.0)
    found, s, d, events = find("grid4x4", row)
    assert (found, s) == ("A1B1_0", 0.0)
    assert abs(d) == pytest.approx(28.0)
    assert events & EVENT_WRONG_WAY


def test_a_vehicle_that_crosses_to_another_road_is_located_there() -> None:
    roads = network("grid4x4")
    row = on_lane(roads, lane_of(roads, "A1B1_0"), 40.0)
    target = on_lane(roads, lane_of(roads, "B1B2_0"), 30.0)
    row["x"], row["y"], row["heading"] = target["x"], target["y"], target["heading"]
    found, s, _, events = find("grid4x4", row)
    assert (found, events) == ("B1B2_0", 0)
    assert s == pytest.approx(30.0)


@given(st.sampled_from(NAMES), st.integers(0, 10_000), st.floats(-3.0, 3.0))
def test_the_side_lane_is_the_adjacent_lane_that_the_body_reaches_into(
    name: str, lane: int, d: float
) -> None:
    roads = network(name)
    lane %= len(roads.lanes)
    here = roads.lanes[lane]
    row = on_lane(roads, lane, 0.0, d=d, width=2.0)[0]
    found = side_lane(roads.arrays, row)
    reach = abs(d) + 1.0 - 0.5 * float(here["width_m"])
    beside = int(here["left"] if d > 0.0 else here["right"])
    if reach > 0.2:
        assert found == beside
    elif reach < -0.2:
        assert found == -1
    else:
        assert found in (-1, beside)
