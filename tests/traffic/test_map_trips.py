"""Places where generated vehicles enter."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError
from tests.support.driving import make_traffic
from tests.support.world import traffic_of


def test_vehicles_enter_anywhere_if_no_usable_road_leads_into_the_map() -> None:
    traffic = traffic_of(make_traffic("grid4x4", background=4, overrides={"traffic.origins": []}))
    trips, num_goals = traffic.trips_of(0), traffic.goal_edges.shape[1]
    ways_in = np.flatnonzero(
        ~traffic.network.lanes["internal"] & (traffic.network.lanes["num_into"] == 0)
    )
    drawn = trips.drawn(traffic.plans, num_goals)
    assert drawn.has_ways_in
    assert set(drawn.entering[:, 0]) <= set(ways_in)
    plans = traffic.plans.copy()
    plans["change"][:, ways_in] = 1
    drawn = trips.drawn(plans, num_goals)
    assert not drawn.has_ways_in
    assert len(drawn.entering) > 0
    assert not set(drawn.entering[:, 0]) & set(ways_in)
    plans["turnarounds"] = 1
    with pytest.raises(ConfigError, match=r"no trip on the map .*: every route .* has a turn"):
        trips.drawn(plans, num_goals)
