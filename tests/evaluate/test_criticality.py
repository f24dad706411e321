from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.math.geometry import boxes_overlap
from cavmarl.evaluate.scenarios.criticality import TRACE, box, least_ttc_s, post_encroachment_s


def body(
    x: float, y: float, heading: float, speed: float, time_s: float = 0.0, size: float = 5.0
) -> NDArray[np.void]:
    return np.array([(time_s, x, y, heading, speed, size, 2.0)], TRACE)


def ttc(one: NDArray[np.void], other: NDArray[np.void]) -> float:
    return least_ttc_s(one, other)


def test_times_to_collision_equal_simple_computations() -> None:
    assert ttc(body(0, 0, 0, 10), body(25, 0, 0, 0)) == pytest.approx(2.0)  # behind a queue
    assert ttc(body(0, 0, 0, 10), body(45, 0, math.pi, 10)) == pytest.approx(2.0)  # head on
    assert ttc(body(0, 0, 0, 10), body(25, 0, 0, 10)) == math.inf  # at equal speeds
    assert ttc(body(0, 0, 0, 10), body(25, 3, 0, 0)) == math.inf  # the other car is on another lane
    assert ttc(body(0, 0, 0, 10), body(-25, 0, 0, 0)) == math.inf  # the other car is behind
    assert ttc(body(0, 0, 0, 10), body(3, 0, 0, 0)) == 0.0
    # Both centres are 20 m before the crossing point. The front of a car is 2.5 m ahead of its
    # centre, and the side of the other car is 1 m nearer than its centre.
    crossing = ttc(body(-20, 0, 0, 10), body(0, -20, 0.5 * math.pi, 10))
    assert crossing == pytest.approx((20 - 2.5 - 1.0) / 10.0)
    passed = ttc(body(-20, 0, 0, 10), body(0, -20, 0.5 * math.pi, 2))
    assert passed == math.inf


places = st.floats(-30.0, 30.0)
bodies = st.builds(body, places, places, st.floats(-math.pi, math.pi), st.floats(-5.0, 15.0))


@given(bodies, bodies)
def test_time_to_collision_equals_a_search_in_small_steps(
    one: NDArray[np.void], other: NDArray[np.void]
) -> None:
    found = ttc(one, other)
    assert found == pytest.approx(ttc(other, one))

    def are_in_contact(time_s: float) -> bool:
        moved = []
        for row in (one[0].copy(), other[0].copy()):
            row["x"] += row["speed"] * math.cos(row["heading"]) * time_s
            row["y"] += row["speed"] * math.sin(row["heading"]) * time_s
            moved.append(row)
        return bool(boxes_overlap(*box(moved[0]), *box(moved[1])))

    hits = [0.01 * k for k in range(600) if are_in_contact(0.01 * k)]
    if hits:
        assert hits[0] - 0.011 <= found <= hits[0] + 1e-9
    elif found < 5.9:
        # The bodies touch for less than 10 ms, so the steps above have missed it.
        assert (
            any(are_in_contact(found + share) for share in np.linspace(0.0, 0.01, 21))
            or found >= 0.0
        )


def line(x: float, y: float, vx: float, vy: float, heading: float) -> NDArray[np.void]:
    times = np.arange(0.0, 10.0, 0.1)
    rows = np.zeros(len(times), TRACE)
    rows["time_s"], rows["x"], rows["y"] = times, x + vx * times, y + vy * times
    rows["heading"], rows["length"], rows["width"] = heading, 4.0, 2.0
    return rows


def test_post_encroachment_time_lasts_from_leaving_to_arriving() -> None:
    east = line(-30.0, 0.0, 10.0, 0.0, 0.0)
    # The rear of `east` leaves the crossing area, 1 m beyond its middle, at 3.3 s.
    later = line(0.0, -60.0, 0.0, 10.0, 0.5 * math.pi)
    # The front of `later` reaches the area, 1 m before its middle, at 5.7 s.
    assert 2.4 <= post_encroachment_s(east, later) <= 2.4 + 2 * 0.1 + 1e-9
    assert post_encroachment_s(later, east) == post_encroachment_s(east, later)
    assert post_encroachment_s(east, line(0.0, -30.0, 0.0, 10.0, 0.5 * math.pi)) == 0.0
    assert post_encroachment_s(east, line(0.0, 5.0, 10.0, 0.0, 0.0)) == math.inf
