from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.driving.kernels.models import idm
from tests.naive import idm as naive

SPEEDS = st.floats(-5.0, 45.0)
DISTANCES = st.floats(-50.0, 200.0) | st.sampled_from([0.0, -0.001, 0.005])
DEFAULTS = (idm.ACCEL_MAX, idm.DECEL_COMFORT, idm.JAM_DISTANCE_M, idm.TIME_HEADWAY_S)


def acceleration(speed: float, target_speed: float, *leader: float) -> float:
    """Return IDM's acceleration behind one leader."""
    _, _, accel_max, *_ = leader
    return idm.idm_free(speed, target_speed, accel_max) - idm.idm_interaction(speed, *leader)


@given(SPEEDS, SPEEDS)
def test_free_acceleration_equals_twin(speed: float, target_speed: float) -> None:
    twin = naive.idm_acceleration(speed, target_speed, None, 0.0, *DEFAULTS)
    assert idm.idm_free(speed, target_speed, idm.ACCEL_MAX) == pytest.approx(twin, rel=1e-12)


@given(SPEEDS, SPEEDS, DISTANCES, SPEEDS, st.floats(0.5, 4.0), st.floats(0.5, 6.0))
def test_acceleration_equals_twin(
    speed: float,
    target_speed: float,
    distance: float,
    front_speed: float,
    accel_max: float,
    decel: float,
) -> None:
    state = (speed, target_speed, distance, front_speed, accel_max, decel, 7.0, 1.2)
    twin = naive.idm_acceleration(*state)
    assert acceleration(*state) == pytest.approx(twin, rel=1e-12, abs=1e-9)


def test_the_acceleration_is_zero_at_target_speed_and_at_jam_distance() -> None:
    assert idm.idm_free(25.0, 25.0, idm.ACCEL_MAX) == 0.0
    jam = acceleration(0.0, 25.0, idm.JAM_DISTANCE_M, 0.0, *DEFAULTS)
    assert jam == pytest.approx(0.0, abs=1e-12)


@given(SPEEDS, st.lists(st.tuples(st.floats(1.0, 100.0), SPEEDS), min_size=1, max_size=4))
def test_the_most_restrictive_leader_determines_the_acceleration(
    speed: float, leaders: list[tuple[float, float]]
) -> None:
    interactions = [idm.idm_interaction(speed, *leader, *DEFAULTS) for leader in leaders]
    accel = idm.idm_free(speed, 30.0, idm.ACCEL_MAX) - max(interactions)
    assert accel == min(acceleration(speed, 30.0, *leader, *DEFAULTS) for leader in leaders)
