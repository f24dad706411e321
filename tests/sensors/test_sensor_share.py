"""A sensor worker gets each row once, and the rows of the agents in its share first."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_BACKGROUND
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.sensors.kernels.sensor_share import put_first, take_rows

shares = st.lists(st.integers(0, 2), min_size=0, max_size=8)


@given(shares, st.integers(0, 4))
def test_agents_that_sense_come_first_and_no_row_is_lost(share: list[int], others: int) -> None:
    agents = len(share)
    published = np.zeros((1, agents + others + 2), dtype=VEHICLE)
    rows = np.zeros_like(published)
    published["driver"][0, :agents] = DRIVER_AGENT
    published["driver"][0, agents : agents + others] = DRIVER_BACKGROUND
    published["agent"][0] = -1
    published["agent"][0, :agents] = np.arange(agents)[::-1]
    published["id"][0, : agents + others] = 10 + np.arange(agents + others)
    take_rows(published, np.array([agents + others]), rows)
    whose = np.array(share if share else [0])
    spare, num_owned = np.zeros(1, dtype=VEHICLE), np.zeros(1, dtype=np.int64)
    for worker in (0, 1, 2, 1):
        lines = np.zeros((1, whose.size, 2), dtype=np.int32)
        lines[0, whose == worker, 1] = 3
        total = put_first(rows, np.array([agents]), lines, spare, num_owned)
        assert total == num_owned[0] == share.count(worker)
        own = rows["agent"][0, :total].tolist()
        assert sorted(own) == [agent for agent, home in enumerate(share) if home == worker]
        there = slice(agents, agents + others)
        assert (rows[0, there] == published[0, there]).all()
        assert sorted(rows["id"][0].tolist()) == sorted(published["id"][0].tolist())
