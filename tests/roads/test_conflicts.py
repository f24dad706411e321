"""Shared areas of two links in a junction, and waiting positions before them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.roads.network import CONFLICT, LANE, LINK
from cavmarl.roads.sumo_net.conflicts import LinkPath, fill_conflicts, overlap, sample_path

TURN, THROUGH = 0, 1  # LINK rows


def straight(begin: tuple[float, float], end: tuple[float, float]) -> LinkPath:
    corners = np.array([[*begin, 0.0], [*end, 0.0]])
    return sample_path(np.array([0.0, float(np.hypot(*(corners[1] - corners[0])[:2]))]), corners)


@pytest.mark.parametrize(("apart_m", "near"), [(2.0, True), (2.7, False), (9.0, False)])
def test_separate_paths_are_not_near_even_if_the_map_lists_them_as_foes(
    apart_m: float, near: bool
) -> None:
    one, other = straight((0.0, 0.0), (20.0, 0.0)), straight((0.0, apart_m), (20.0, apart_m))
    shared = overlap(one, other, merging=False)
    assert shared is not None
    assert shared.near == near
    merging = overlap(one, other, merging=True)
    assert merging is not None
    assert merging.near, "merging paths are not near"


def waiting_place(
    wait_m: float, enter_m: float, yields: tuple[bool, bool] = (True, False)
) -> float:
    """Return a turn's waiting position, for netconvert's position and the area's start, in m."""
    links, lanes = np.zeros(2, LINK), np.zeros(2, LANE)
    links["wait_m"] = wait_m, np.inf
    links["from_lane"] = links["to_lane"] = 0, 1
    links["signal"] = -1
    conflicts: NDArray[np.void] = np.zeros(2, CONFLICT)
    conflicts["foe"] = THROUGH, TURN
    conflicts["must_yield"] = yields
    conflicts["enter_m"] = enter_m, 4.0
    fill_conflicts(lanes, links, conflicts, np.array([0, 1, 2], np.int32))
    assert links["wait_m"][THROUGH] == np.inf
    return float(links["wait_m"][TURN])


@pytest.mark.parametrize(
    ("enter_m", "place_m"),
    [
        (9.5, 10.0),  # a front stops 1 m before the position, so 0.5 m before the area
        (8.9, 9.9),
        (6.1, 7.1),
        (5.9, 10.0),  # over 3 m before the position, so vehicles wait at the stop line
    ],
)
def test_a_turn_waits_inside_the_junction_before_the_shared_area(
    enter_m: float, place_m: float
) -> None:
    assert waiting_place(10.0, enter_m) == pytest.approx(place_m)


@pytest.mark.parametrize("yields", [(False, True), (True, True), (False, False)])
def test_a_waiting_position_moves_only_if_the_other_link_has_priority(
    yields: tuple[bool, bool],
) -> None:
    assert waiting_place(10.0, 8.0, yields) == 10.0


def test_a_turn_without_a_waiting_position_of_netconvert_gets_none() -> None:
    assert waiting_place(np.inf, 8.0) == np.inf
