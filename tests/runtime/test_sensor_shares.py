"""Who senses what: nothing is left out, in turn is in turn, and by cost is not slower."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.runtime.sensor_shares import Unit, cut, share_by_cost, share_in_turn

costs = st.lists(st.floats(1e-6, 1.0), min_size=1, max_size=24)
workers = st.integers(1, 6)


@given(st.lists(st.integers(0, 9), min_size=1, unique=True), st.integers(1, 200), workers)
def test_units_cover_every_agent_of_every_sensor_once(
    sensors: list[int], agents: int, count: int
) -> None:
    share = np.full((10, agents), -1, dtype=np.int16)
    units = cut(sorted(sensors), agents, count)
    shares = share_in_turn(units, [1.0] * len(units), count)
    shares.write(share)
    assert (share[sensors] >= 0).all()
    assert (share[sensors] < count).all()
    assert (share[[k for k in range(10) if k not in sensors]] == -1).all()
    assert sum(unit.last - unit.first for unit in units) == len(sensors) * agents


@given(costs, workers)
def test_by_cost_is_never_slower_than_in_turn(costs_s: list[float], count: int) -> None:
    units = [Unit(sensor, 0, 1) for sensor in range(len(costs_s))]
    in_turn = share_in_turn(units, costs_s, count)
    by_cost = share_by_cost(units, costs_s, count)
    assert by_cost.units == in_turn.units
    assert all(0 <= home < count for home in by_cost.homes)
    # Graham's bound for the costliest first, against the least that any way could take.
    least = max(max(costs_s), sum(costs_s) / count)
    assert max(by_cost.loads_s) <= (4.0 / 3.0) * least + 1e-12 or max(by_cost.loads_s) <= max(
        in_turn.loads_s
    )
    assert sum(by_cost.loads_s) == pytest.approx(sum(costs_s))


def test_unequal_sensors_end_together() -> None:
    units = [Unit(sensor, 0, 1) for sensor in range(6)]
    costs_s = [6.0, 1.0, 5.0, 1.0, 4.0, 1.0]
    assert share_in_turn(units, costs_s, 2).loads_s == [15.0, 3.0]
    assert max(share_by_cost(units, costs_s, 2).loads_s) == 9.0


def test_more_workers_than_sensors() -> None:
    shares = share_by_cost([Unit(3, 0, 1)], [1.0], 4)
    assert shares.loads_s == [1.0, 0.0, 0.0, 0.0]
