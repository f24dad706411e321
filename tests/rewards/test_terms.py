from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.config.terms import TERMS
from cavmarl.core.math.neighbors import fill_grid, make_grid
from cavmarl.core.records.codes import (
    EVENT_ARRIVED,
    EVENT_COLLIDED,
    EVENT_OFF_ROAD,
    EVENT_RED_LIGHT,
    EVENT_WRONG_WAY,
)
from cavmarl.driving.kernels.motion.motion import MAX_SPEED_MPS
from cavmarl.driving.vehicle_emissions import emissions_of
from cavmarl.driving.vehicle_types import generated_types
from cavmarl.rewards.kernels.terms import TTC_HORIZON_S, write_terms
from tests.naive.terms import ttc_risk
from tests.support.builders import crowds, vehicles
from tests.support.traffic import network

STEP_S = 0.1


def terms(rows: NDArray[np.void], i: int = 0, max_speed: float = MAX_SPEED_MPS) -> dict[str, float]:
    """Return the terms of row i by name; all vehicles drive on lane 0 of the ring."""
    kind = generated_types().copy()
    kind["max_speed"] = max_speed
    grid = make_grid((-100.0, -100.0, 100.0, 100.0), 25.0, len(rows))
    fill_grid(rows, len(rows), grid)
    out = np.full(len(TERMS), np.nan, np.float32)
    write_terms(network("ring").arrays, rows, i, kind[0], grid, STEP_S, out)
    return dict(zip(TERMS, out.tolist(), strict=True))


def one_vehicle(**fields: object) -> NDArray[np.void]:
    return vehicles([(0.0, 0.0, 0.0)], **fields)


LIMIT_MPS = float(network("ring").lanes[0]["speed_mps"])


def test_every_term_is_a_finite_number() -> None:
    assert all(math.isfinite(value) for value in terms(one_vehicle()).values())


def test_progress_is_the_decrease_of_the_distance_to_the_goal() -> None:
    assert terms(one_vehicle(speed=10.0, step_to_go=80.0, to_go=79.0))["progress"] == 1.0
    assert terms(one_vehicle(speed=10.0, step_to_go=79.0, to_go=80.0))["progress"] == -1.0


@pytest.mark.parametrize(
    ("before", "after", "speed", "progress"),
    # Progress is limited to two steps at the present speed, or at 1 m/s for slower vehicles.
    [
        (80.0, 900.0, 10.0, -2.0),
        (900.0, 80.0, 10.0, 2.0),
        (80.0, 81.9, 10.0, -1.9),
        (80.0, 78.1, 10.0, 1.9),
        (80.0, 900.0, 0.0, -0.2),
        (900.0, 80.0, 0.5, 0.2),
        (80.0, 79.85, 0.0, 0.15),
        (80.0, math.inf, 10.0, -2.0),
        (math.inf, 80.0, 10.0, 0.0),
        (math.inf, math.inf, 10.0, 0.0),
    ],
)
def test_progress_is_limited_when_the_route_changes(
    before: float, after: float, speed: float, progress: float
) -> None:
    found = terms(one_vehicle(speed=speed, step_to_go=before, to_go=after))["progress"]
    assert found == pytest.approx(progress, abs=1e-6)


def test_speeding_and_delay_are_relative_to_the_speed_limit() -> None:
    slow, right, fast = (terms(one_vehicle(speed=share * LIMIT_MPS)) for share in (0.5, 1.0, 1.25))
    assert [round(found["speeding"], 6) for found in (slow, right, fast)] == [0.0, 0.0, 0.25]
    assert slow["delay"] == pytest.approx(0.5 * STEP_S)
    assert right["delay"] == fast["delay"] == 0.0
    assert terms(one_vehicle(speed=0.0))["delay"] == pytest.approx(STEP_S)


def test_a_slow_vehicle_type_has_no_delay_at_its_maximum_speed() -> None:
    assert terms(one_vehicle(speed=4.0), max_speed=4.0)["delay"] == 0.0
    assert terms(one_vehicle(speed=3.0), max_speed=4.0)["delay"] == pytest.approx(0.25 * STEP_S)


def test_the_term_jerk_is_the_mean_of_the_step() -> None:
    # In the step of 0.1 s, the acceleration rises by 2 m/s² and falls by 2 m/s².
    assert terms(one_vehicle(step_jerk=4.0))["jerk"] == pytest.approx(4.0 / STEP_S / 10.0)


def test_energy_and_co2_are_those_of_the_step() -> None:
    row = one_vehicle(speed=12.0, accel=1.0, pitch=0.02)
    energy_wh, co2_g = emissions_of(row, np.zeros(1, np.int64), STEP_S)[0].tolist()
    found = terms(row)
    assert found["energy"] == pytest.approx(energy_wh)
    assert found["co2"] == pytest.approx(co2_g)
    assert min(energy_wh, co2_g) > 0.0
    braking = terms(one_vehicle(speed=12.0, accel=-2.0))
    assert braking["energy"] < 0.0 == braking["co2"]


@pytest.mark.parametrize(
    ("bit", "name"),
    [
        (EVENT_COLLIDED, "collision"),
        (EVENT_OFF_ROAD, "off_road"),
        (EVENT_WRONG_WAY, "wrong_way"),
        (EVENT_RED_LIGHT, "red_light"),
        (EVENT_ARRIVED, "arrival"),
    ],
)
def test_event_terms_are_1_in_the_step_of_the_event(bit: int, name: str) -> None:
    flags = ("collision", "off_road", "wrong_way", "red_light", "arrival")
    found = terms(one_vehicle(events=bit))
    assert [flag for flag in flags if found[flag] == 1.0] == [name]
    assert all(found[flag] in (0.0, 1.0) for flag in flags)


def test_the_collision_risk_of_a_faster_follower_follows_from_gap_and_speeds() -> None:
    # The follower is 10 m/s faster and the gap is 20 m, so the time to collision is 2 s.
    rows = vehicles([(0.0, 0.0, 0.0), (25.0, 0.0, 0.0)], speed=[15.0, 5.0])
    assert terms(rows)["ttc_risk"] == pytest.approx(1.0 - 2.0 / TTC_HORIZON_S)
    assert terms(rows[::-1], 1)["ttc_risk"] == terms(rows)["ttc_risk"]
    # If one vehicle is 1 m longer, the gap is 0.5 m shorter.
    for lengths in ((6.0, 5.0), (5.0, 6.0)):
        longer = rows.copy()
        longer["length"] = lengths
        assert terms(longer)["ttc_risk"] == pytest.approx(1.0 - 1.95 / TTC_HORIZON_S)
    rows["speed"] = [5.0, 15.0]
    assert terms(rows)["ttc_risk"] == 0.0
    rows["speed"] = [15.0, 5.0]
    rows["z"] = [0.0, 6.0]
    assert terms(rows)["ttc_risk"] == 0.0, "a vehicle on a bridge counts"
    rows["z"] = 0.0
    rows["y"] = [0.0, 3.2]
    assert terms(rows)["ttc_risk"] == 0.0, "a vehicle on the next lane counts"


def test_adjacent_cars_have_a_collision_risk_only_if_they_approach_sideways() -> None:
    rows = vehicles([(0.0, 0.0, 0.0), (1.0, 3.2, 0.0)], speed=[15.0, 10.0])
    assert terms(rows)["ttc_risk"] == 0.0, "passing on the next lane counts"
    # The sides are 1.2 m apart; one vehicle approaches the other sideways at 1 m/s.
    rows["heading"] = [math.asin(0.1), 0.0]
    rows["speed"] = [10.0, 10.0]
    turned_m = 2.5 * 0.1 + 1.0 * math.cos(math.asin(0.1)) - 1.0
    assert terms(rows)["ttc_risk"] == pytest.approx(1.0 - (1.2 - turned_m) / TTC_HORIZON_S)
    rows["y"] = [0.0, 1.9]
    assert terms(rows)["ttc_risk"] == 1.0, "touching vehicles do not count"


@given(crowds(), st.integers(0, 11))
def test_time_to_collision_equals_twin(rows: NDArray[np.void], i: int) -> None:
    i %= len(rows)
    found = terms(rows, i)["ttc_risk"]
    assert 0.0 <= found <= 1.0
    # Rounding decides whether nearly touching bodies touch. So compare with bodies that are 1 µm
    # smaller and larger.
    assert ttc_risk(rows, i, -1e-6) - 1e-4 <= found <= ttc_risk(rows, i, 1e-6) + 1e-4


@given(crowds(), st.randoms(use_true_random=False))
def test_terms_do_not_depend_on_the_order_of_rows(rows: NDArray[np.void], random: object) -> None:
    order = list(range(len(rows)))
    random.shuffle(order)  # type: ignore[attr-defined]
    for i in range(len(rows)):
        assert terms(rows, i) == terms(rows[order], order.index(i))
