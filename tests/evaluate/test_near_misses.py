"""Post-encroachment times equal their closed form; positions of agents are found."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.driving.vehicles import VEHICLE
from cavmarl.evaluate.encounters import mirrored_conflicts
from cavmarl.evaluate.kernels.near_misses import locate_agents, watch_encroachments
from tests.naive.encroachment import Passage, least_encroachments
from tests.support.traffic import network

ROADS = network("grid4x4")
MIRROR = mirrored_conflicts(ROADS)
STEP_S = 0.1
STEPS = 150
# The links of the junction with the most links.
JUNCTION = int(np.bincount(ROADS.links["junction"]).argmax())
LINKS = np.flatnonzero(ROADS.links["junction"] == JUNCTION).tolist()


def place(row: np.void, passage: Passage, centre_m: float) -> None:
    """Place a vehicle on the path of its link, with its centre `centre_m` beyond the stop line."""
    link = ROADS.links[passage.link]
    row["speed"], row["length"] = passage.speed_mps, passage.length_m
    row["link"] = passage.link if centre_m >= 0.0 else -1
    row["lane"] = link["from_lane"]
    row["s"] = ROADS.lanes[link["from_lane"]]["length_m"] + centre_m
    if centre_m >= 0.0:
        lane, rest = int(link["first_internal"]), centre_m
        while ROADS.lanes[lane]["internal"] and rest >= ROADS.lanes[lane]["length_m"]:
            rest -= float(ROADS.lanes[lane]["length_m"])
            lane = int(ROADS.lanes[lane]["successor"])
        row["lane"], row["s"] = lane, rest


def watch(passages: list[Passage], order: list[int] | None = None) -> NDArray[np.float64]:
    """Return the least post-encroachment time in s of each agent k, which drives passages[k]."""
    count = len(passages)
    rows = np.zeros((1, count), VEHICLE)
    shape = (1, len(MIRROR))
    seen_s = np.full(shape, -np.inf)
    seen_id = np.full(shape, -1, np.int64)
    seen_agent = np.full(shape, -1, np.int32)
    least = np.full((1, count), np.inf)
    for step in range(STEPS):
        for i, k in enumerate(order or range(count)):
            rows[0, i]["agent"], rows[0, i]["id"] = k, 100 + k
            passage = passages[k]
            place(rows[0, i], passage, passage.start_m + passage.speed_mps * step * STEP_S)
        watch_encroachments(
            ROADS.arrays,
            MIRROR,
            rows,
            np.array([count]),
            np.array([True]),
            np.arange(100, 100 + count)[None],
            step * STEP_S,
            STEP_S,
            seen_s,
            seen_id,
            seen_agent,
            least,
        )
    return least[0]


@st.composite
def passages(draw: st.DrawFn) -> list[Passage]:
    """Draw vehicles on different links that start before the junction and leave it within STEPS."""
    links = draw(st.lists(st.sampled_from(LINKS), min_size=2, max_size=6, unique=True))
    return [
        Passage(
            link,
            -draw(st.floats(0.5, 30.0)),
            draw(st.floats(6.0, 15.0)),
            draw(st.sampled_from([4.0, 5.0, 12.0])),
        )
        for link in links
    ]


@settings(max_examples=60, deadline=None)
@given(passages())
def test_post_encroachment_times_equal_their_closed_form(drawn: list[Passage]) -> None:
    expected = least_encroachments(ROADS, drawn)
    np.testing.assert_allclose(watch(drawn), expected, atol=1e-6)


@settings(max_examples=20, deadline=None)
@given(passages(), st.data())
def test_the_order_of_rows_does_not_matter(drawn: list[Passage], data: st.DataObject) -> None:
    order = data.draw(st.permutations(range(len(drawn))))
    np.testing.assert_array_equal(watch(drawn), watch(drawn, order))


def crossing() -> tuple[int, np.void]:
    """Return a link of the junction and its conflict with a crossing link."""
    for link in LINKS:
        first = int(ROADS.links[link]["first_conflict"])
        for c in range(first, first + int(ROADS.links[link]["num_conflicts"])):
            if MIRROR[c] >= 0:
                return link, ROADS.conflicts[c]
    raise AssertionError("no links that cross")


def test_post_encroachment_time_begins_when_the_last_earlier_vehicle_has_passed() -> None:
    one, conflict = crossing()
    other = int(conflict["foe"])
    platoon = [Passage(one, start, 10.0, 5.0) for start in (-5.0, -20.0)]
    late = Passage(other, -60.0, 10.0, 5.0)
    alone = least_encroachments(ROADS, [platoon[1], late])
    first, second, third = watch([*platoon, late])
    assert first == np.inf
    assert (second, third) == pytest.approx(alone, abs=1e-6)


def test_vehicles_in_an_area_at_the_same_time_have_the_post_encroachment_time_0() -> None:
    one, conflict = crossing()
    middle = 0.5 * (conflict["enter_m"] + conflict["leave_m"])
    foe_middle = 0.5 * (conflict["foe_enter_m"] + conflict["foe_leave_m"])
    both = [
        Passage(one, float(middle) - 30.0, 8.0, 5.0),
        Passage(int(conflict["foe"]), float(foe_middle) - 30.0, 8.0, 5.0),
    ]
    assert watch(both).tolist() == [0.0, 0.0]


def test_each_crossing_conflict_has_its_mirror_and_merging_conflicts_have_none() -> None:
    link = np.repeat(np.arange(len(ROADS.links)), ROADS.links["num_conflicts"])
    watched = np.flatnonzero(MIRROR >= 0)
    assert watched.size
    np.testing.assert_array_equal(MIRROR[MIRROR[watched]], watched)
    np.testing.assert_array_equal(link[MIRROR[watched]], ROADS.conflicts["foe"][watched])
    merging = ROADS.links["to_lane"][link] == ROADS.links["to_lane"][ROADS.conflicts["foe"]]
    assert merging.any()
    assert (MIRROR[merging] == -1).all()


def test_each_agent_has_the_position_of_its_vehicle() -> None:
    rows = np.zeros((2, 3), VEHICLE)
    rows["agent"] = [[1, -1, 0], [0, 1, -1]]
    rows["x"] = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    rows["y"] = -rows["x"]
    places = np.full((2, 2, 2), np.nan)
    locate_agents(rows, np.array([2, 1]), places)
    np.testing.assert_array_equal(places[0], [[np.nan, np.nan], [1.0, -1.0]])
    np.testing.assert_array_equal(places[1], [[4.0, -4.0], [np.nan, np.nan]])
