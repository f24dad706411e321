"""Shares of sensor workers are complete; sharing by cost is never slower than round-robin.

A unit is a sensor with a range of agents; each worker senses some units.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.parallel.sensor_workers.line_costs import LineCosts
from cavmarl.parallel.sensor_workers.sensor_shares import (
    MIN_GAIN_S,
    Unit,
    cut,
    divide,
    share_by_cost,
    share_in_turn,
)

costs = st.lists(st.floats(1e-6, 1.0), min_size=1, max_size=24)
workers = st.integers(1, 6)


@given(st.lists(st.integers(0, 9), min_size=1, unique=True), st.integers(1, 200), workers)
def test_units_cover_every_agent_of_every_sensor_once(
    sensors: list[int], agents: int, count: int
) -> None:
    lines = np.full((count, 10, agents, 2), -1, dtype=np.int32)
    units = cut({sensor: 1 + sensor for sensor in sorted(sensors)}, agents, count)
    shares = share_in_turn(units, [1.0] * len(units), count)
    shares.write(lines)
    written = lines[..., 1] - lines[..., 0]
    assert (written[:, sensors].sum(axis=0) == np.array(sensors)[:, np.newaxis] + 1).all()
    assert ((written[:, sensors] > 0).sum(axis=0) == 1).all()
    assert (lines[:, [k for k in range(10) if k not in sensors]] == -1).all()
    assert sum(unit.last - unit.first for unit in units) == len(sensors) * agents


@given(costs, workers)
def test_sharing_by_cost_is_never_slower_than_round_robin(costs_s: list[float], count: int) -> None:
    units = [Unit(sensor, 0, 1) for sensor in range(len(costs_s))]
    in_turn = share_in_turn(units, costs_s, count)
    by_cost = share_by_cost(units, costs_s, count)
    assert by_cost.units == in_turn.units
    assert all(0 <= home < count for home in by_cost.homes)
    # Graham's bound for longest-processing-time-first scheduling; `least` is a lower bound for any
    # schedule.
    least = max(max(costs_s), sum(costs_s) / count)
    assert max(by_cost.loads_s) <= (4.0 / 3.0) * least + 1e-12 or max(by_cost.loads_s) <= max(
        in_turn.loads_s
    )
    assert sum(by_cost.loads_s) == pytest.approx(sum(costs_s))


def test_sharing_by_cost_balances_unequal_sensors() -> None:
    units = [Unit(sensor, 0, 1) for sensor in range(6)]
    costs_s = [6.0, 1.0, 5.0, 1.0, 4.0, 1.0]
    assert share_in_turn(units, costs_s, 2).loads_s == [15.0, 3.0]
    assert max(share_by_cost(units, costs_s, 2).loads_s) == 9.0


def test_workers_without_a_sensor_have_no_load() -> None:
    shares = share_by_cost([Unit(3, 0, 1)], [1.0], 4)
    assert shares.loads_s == [1.0, 0.0, 0.0, 0.0]


sizes = st.lists(st.tuples(st.integers(1, 300), st.floats(1e-6, 0.1)), min_size=1, max_size=8)


@given(sizes, workers, st.integers(1, 3))
def test_every_line_of_divided_frames_is_written_once(
    sensors: list[tuple[int, float]], count: int, agents: int
) -> None:
    num_lines = [lines for lines, _ in sensors]
    units = cut(dict(enumerate(num_lines)), agents, count)
    costs_s = [sensors[unit.sensor][1] * (unit.last - unit.first) for unit in units]
    whole = share_by_cost(units, costs_s, count)
    shares = divide(whole, LineCosts(num_lines))
    assert len(shares.units) < len(units) + count
    assert sum(shares.loads_s) == pytest.approx(sum(costs_s))
    assert max(shares.loads_s) <= max(whole.loads_s) * (1.0 + 1e-9)
    written = np.zeros((len(sensors), agents, max(num_lines)), dtype=np.int64)
    lines = np.zeros((count, len(sensors), agents, 2), dtype=np.int32)
    shares.write(lines)
    for worker, sensor, agent in np.ndindex(*lines.shape[:3]):
        begin, end = lines[worker, sensor, agent]
        written[sensor, agent, begin:end] += 1
    for sensor, most in enumerate(num_lines):
        assert (written[sensor, :, :most] == 1).all()
        assert (written[sensor, :, most:] == 0).all()


def test_one_large_frame_is_divided_to_balance_all_workers() -> None:
    units = [Unit(0, 0, 1, 0, 4096), Unit(1, 0, 1, 0, 1000), Unit(2, 0, 1)]
    costs_s = [16e-3, 4e-3, 1e-3]
    shares = divide(share_by_cost(units, costs_s, 3), LineCosts([4096, 1000, 1]))
    assert shares.loads_s == pytest.approx([7e-3] * 3, abs=2e-5)
    assert set(shares.divided) == {0}


def test_frames_are_not_divided_without_a_gain() -> None:
    units = [Unit(0, 0, 1, 0, 100), Unit(1, 0, 1, 0, 100)]
    costs_s = [1e-3 + 1.9 * MIN_GAIN_S, 1e-3]
    whole = share_by_cost(units, costs_s, 2)
    assert divide(whole, LineCosts([100, 100])) == whole


def test_the_costs_of_lines_are_learned_from_measured_parts() -> None:
    """Each line of the lower half costs four times as much as one of the upper half.

    Half of the total cost is reached at 3/8 of the lower half, so at line 687.
    """
    true = np.repeat([1.0, 4.0], 500) / 2500.0
    found = LineCosts([1000])
    for _ in range(12):
        shares = divide(share_by_cost([Unit(0, 0, 1, 0, 1000)], [10e-3], 2), found)
        ((_, parts),) = shares.divided.items()
        spent_s = [10e-3 * float(true[begin:end].sum()) for _, (begin, end) in parts]
        found.learn(0, [lines for _, lines in parts], spent_s)
    assert max(spent_s) == pytest.approx(5e-3, rel=0.02)
    assert parts[0][1] == (0, pytest.approx(687, abs=20))
