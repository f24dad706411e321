from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from cavmarl.driving.kernels.lanes.lane_change import mobil_accepts
from tests.naive import lane_change as naive

ACCEL = st.floats(-6.0, 3.0) | st.sampled_from([-2.0, 0.0, 0.2, 2.0])
PAIR = st.tuples(ACCEL, ACCEL)


@given(PAIR, PAIR, PAIR, st.booleans())
def test_mobil_equals_twin(
    own: tuple[float, float],
    new_follower: tuple[float, float],
    old_follower: tuple[float, float],
    mandatory: bool,
) -> None:
    accepted = mobil_accepts(*own, *new_follower, *old_follower, mandatory)
    assert accepted == naive.mobil_accepts(own, new_follower, old_follower, mandatory)


def test_a_mandatory_change_needs_safety_but_no_gain() -> None:
    assert mobil_accepts(1.0, -1.5, 0.0, -2.0, 0.0, 0.0, True)
    assert not mobil_accepts(1.0, -1.5, 0.0, -2.0, 0.0, 0.0, False)
    assert not mobil_accepts(1.0, -2.1, 0.0, -2.0, 0.0, 0.0, True)
    assert not mobil_accepts(1.0, -1.5, 0.0, -2.1, 0.0, 0.0, True)


def test_the_largest_imposed_braking_is_a_parameter() -> None:
    assert mobil_accepts(1.0, -3.9, 0.0, -3.9, 0.0, 0.0, True, 4.0)
    assert not mobil_accepts(1.0, -4.1, 0.0, -3.9, 0.0, 0.0, True, 4.0)
    assert not mobil_accepts(1.0, -3.9, 0.0, -4.1, 0.0, 0.0, True, 4.0)


def test_changes_exactly_at_the_thresholds_are_accepted() -> None:
    assert mobil_accepts(0.0, 0.2, 0.0, -2.0, 0.0, 0.0, False)
    assert mobil_accepts(0.0, -2.0, 0.0, -2.0, 0.0, 0.0, True)
