from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.core.records.codes import MODEL_IDM, MODEL_KRAUSS
from cavmarl.driving.kernels.models.car_following_model import LINE_MARGIN_M
from cavmarl.driving.kernels.models.following import (
    MODELS,
    accel_behind,
    before_line,
    behind,
    no_constraint,
    response,
    speed_behind,
    wish,
)
from cavmarl.driving.kernels.models.registered_models import FIRST_REGISTERED
from cavmarl.driving.vehicle_types import CLASS_DEFAULTS, VTYPE, generated_types, set_model
from tests.naive import following as naive

DT = 0.1
IDM = generated_types()[0]
SPEEDS = st.floats(0.0, 40.0)
GAPS = st.floats(-2.0, 200.0)
DECELS = st.floats(1.0, 9.0)
SHARES = st.floats(0.0, 1.0, exclude_max=True)


def passenger_car(model: int, sigma: float = 0.0) -> np.void:
    """Return SUMO's passenger car with the car-following model MODEL_*."""
    car = np.zeros(1, VTYPE)[0]
    for field, value in CLASS_DEFAULTS["passenger"]._asdict().items():
        if field in (VTYPE.names or ()):
            car[field] = value
    set_model(car, model)
    car["tau"], car["sigma"] = 1.0, sigma
    return car


KINDS = {model.name: passenger_car(model.code) for model in MODELS} | {"IDM": IDM}


def test_each_model_has_a_different_code() -> None:
    codes = {model.code for model in MODELS}
    assert len(codes) == len(MODELS)
    assert max(codes) < FIRST_REGISTERED


def constraint_of(kind: np.void, speed: float, leaders: list[tuple[float, float, float]]) -> float:
    constraint = no_constraint(kind)
    for gap, front_speed, front_decel in leaders:
        constraint = max(constraint, behind(kind, speed, gap, front_speed, front_decel))
    return constraint


LEADERS = st.lists(st.tuples(GAPS, SPEEDS, DECELS), max_size=3)


@given(SPEEDS, st.floats(1.0, 40.0), LEADERS)
def test_idm_response_equals_twin(
    speed: float, allowed: float, leaders: list[tuple[float, float, float]]
) -> None:
    constraint = constraint_of(IDM, speed, leaders)
    twin = naive.idm_response(IDM, speed, allowed, [(gap, front) for gap, front, _ in leaders])
    assert response(IDM, speed, allowed, constraint, 0.3, DT) == pytest.approx(twin, abs=1e-9)


@given(SPEEDS, st.floats(1.0, 40.0), LEADERS, SHARES, st.floats(0.0, 1.0))
def test_krauss_response_equals_twin(
    speed: float,
    allowed: float,
    leaders: list[tuple[float, float, float]],
    share: float,
    sigma: float,
) -> None:
    kind = passenger_car(MODEL_KRAUSS, sigma)
    constraint = constraint_of(kind, speed, leaders)
    twin = naive.krauss_response(kind, speed, allowed, leaders, share, DT)
    assert response(kind, speed, allowed, constraint, share, DT) == pytest.approx(twin, abs=1e-6)


@given(SPEEDS, LEADERS, SHARES)
def test_krauss_never_brakes_to_a_negative_speed(
    speed: float, leaders: list[tuple[float, float, float]], share: float
) -> None:
    kind = passenger_car(MODEL_KRAUSS, 0.5)
    accel = response(kind, speed, 30.0, constraint_of(kind, speed, leaders), share, DT)
    assert speed + accel * DT >= -1e-9
    assert accel >= -kind["emergency_decel"]


@pytest.mark.parametrize("name", ["IDM", "Krauss"])
@given(speed=SPEEDS, gap=GAPS, more=st.floats(0.1, 50.0), front=SPEEDS)
def test_a_nearer_leader_constrains_at_least_as_much_as_a_farther_one(
    name: str, speed: float, gap: float, more: float, front: float
) -> None:
    kind = KINDS[name]
    near, far = (behind(kind, speed, at, front, kind["decel"]) for at in (gap, gap + more))
    # IDM squares its desired gap, which may be negative behind a faster leader; skip those cases.
    desired = kind["tau"] * speed + speed * (speed - front) / 7.8
    if kind["model"] == MODEL_KRAUSS or desired > -kind["min_gap"]:
        assert near >= far
    assert far >= no_constraint(kind)


@pytest.mark.parametrize("name", ["IDM", "Krauss"])
@given(gap=st.floats(-5.0, 150.0), front=SPEEDS, front_decel=DECELS)
def test_speed_behind_returns_the_speed_whose_desired_gap_is_the_given_gap(
    name: str, gap: float, front: float, front_decel: float
) -> None:
    kind = KINDS[name]
    speed = speed_behind(kind, gap, front, front_decel)
    assert speed >= 0.0
    if speed < 1e-3:
        return
    constraint = behind(kind, speed, gap, front, front_decel)
    if kind["model"] == MODEL_IDM:
        # At the desired gap, the interaction term equals the largest acceleration.
        assert constraint == pytest.approx(kind["accel"], rel=1e-6)
    else:
        assert -constraint == pytest.approx(speed)


@pytest.mark.parametrize("name", KINDS)
def test_accel_behind_equals_wish_with_the_constraint_of_the_leader(name: str) -> None:
    kind = KINDS[name]
    constraint = behind(kind, 12.0, 20.0, 9.0, 4.0)
    assert accel_behind(kind, 12.0, 15.0, 20.0, 9.0, 4.0) == wish(kind, 12.0, 15.0, constraint)
    assert wish(kind, 12.0, 15.0, no_constraint(kind)) > wish(kind, 12.0, 15.0, constraint)


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("dt", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("speed", [5.0, 14.0, 25.0])
def test_a_driver_stops_just_before_a_line(name: str, dt: float, speed: float) -> None:
    kind = KINDS[name]
    gap, hardest, desired = 90.0, 0.0, speed
    for _ in range(round(60.0 / dt)):
        accel = response(kind, speed, desired, before_line(kind, speed, gap, dt), 0.0, dt)
        hardest = max(hardest, -accel)
        speed = max(speed + accel * dt, 0.0)
        gap -= speed * dt
    assert speed < 0.1
    assert 0.0 < gap < 2.0 * LINE_MARGIN_M
    assert hardest < 1.25 * kind["decel"], (
        "the driver braked too hard before a line that it saw early"
    )


@pytest.mark.parametrize("name", KINDS)
def test_a_follower_stops_behind_a_leader_that_brakes_hard(name: str) -> None:
    kind = KINDS[name]
    speed = front_speed = 14.0
    gap = 25.0
    for tick in range(400):
        constraint = behind(kind, speed, gap, front_speed, kind["decel"])
        accel = response(kind, speed, 14.0, constraint, 0.0, DT)
        speed = max(speed + accel * DT, 0.0)
        if tick > 50:
            front_speed = max(front_speed - kind["decel"] * DT, 0.0)
        gap += (front_speed - speed) * DT
        assert gap > 0.5 * kind["min_gap"]
    assert speed < 0.1
    assert gap < kind["min_gap"] + 1.5


@given(allowed=SPEEDS, further=st.floats(-40.0, 40.0), gap=st.floats(-2.0, 2.4), share=SHARES)
def test_a_driver_close_behind_a_standing_leader_ignores_other_constraints(
    allowed: float, further: float, gap: float, share: float
) -> None:
    # Therefore, the kernel in `drivers` may stop its search for constraints at such a leader.
    car = passenger_car(MODEL_KRAUSS, 0.5)
    constraint = behind(car, 0.0, gap, 0.0, 4.5)
    assert constraint == 0.0
    for whole in (constraint, max(constraint, further)):
        assert response(car, 0.0, allowed, whole, share, DT) == 0.0
    assert wish(car, 0.0, allowed, constraint) == wish(car, 0.0, 0.0, constraint) == 0.0
