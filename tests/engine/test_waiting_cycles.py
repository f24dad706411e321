"""Search for deadlocks, which are lists of vehicle ids."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import ConfigError, EpisodeError, parallel_env
from cavmarl.core.records.codes import HOLD_SIGNAL, HOLD_YIELD
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.engine.waiting_cycles import find_deadlocks
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import PLAN
from tests.support.traffic import network

LEFT = ord("l")


def block(roads: RoadNetwork) -> tuple[list[int], NDArray[np.void]]:
    """Return the lanes of left turns around a block, and the route steps from lane to lane."""
    left = roads.links[roads.links["direction"] == LEFT]
    onward = dict(zip(left["from_lane"].tolist(), left["to_lane"].tolist(), strict=True))
    for first in sorted(onward):
        lanes = [first]
        while onward.get(lanes[-1], first) not in lanes:
            lanes.append(onward[lanes[-1]])
        if onward.get(lanes[-1]) == first:
            break
    steps = np.zeros(len(roads.lanes), PLAN)
    steps["next"] = steps["link"] = -1
    for lane in lanes:
        links = np.flatnonzero(
            (roads.links["from_lane"] == lane) & (roads.links["direction"] == LEFT)
        )
        steps["link"][lane], steps["next"][lane] = links[0], roads.links["next_lane"][links[0]]
    return lanes, steps


def queues(roads: RoadNetwork, lanes: list[int]) -> NDArray[np.void]:
    """Return queues of standing vehicles that fill these lanes; ids rise along the lanes."""
    rows = []
    for lane in lanes:
        for s in np.arange(3.0, roads.lanes["length_m"][lane] - 3.0, 7.0).tolist():
            row = blank_vehicle()
            row["id"], row["lane"], row["s"], row["wait_s"] = 7 + len(rows), lane, s, 60.0
            rows.append(row)
    return np.concatenate(rows)


def test_a_full_block_is_a_deadlock_of_all_its_vehicles() -> None:
    roads = network("grid4x4")
    lanes, steps = block(roads)
    rows = queues(roads, lanes)
    (cycle,) = find_deadlocks(roads, steps, rows)
    assert cycle[0] == 7
    assert sorted(cycle) == rows["id"].tolist()
    shuffled = rows[np.random.default_rng(1).permutation(len(rows))]
    assert find_deadlocks(roads, steps, shuffled) == (cycle,)


def test_a_queue_that_will_move_is_no_deadlock() -> None:
    roads = network("grid4x4")
    lanes, steps = block(roads)
    rows = queues(roads, lanes)
    first = rows["lane"] == lanes[0]
    for change in ({"hold": HOLD_SIGNAL}, {"speed": 2.0}, {"wait_s": 1.0}):
        moving = rows.copy()
        for name, value in change.items():
            moving[name][np.flatnonzero(first)[-1]] = value
        assert find_deadlocks(roads, steps, moving) == ()
    assert find_deadlocks(roads, steps, rows[~first]) == ()


def test_vehicles_that_yield_to_each_other_are_a_deadlock() -> None:
    roads = network("grid4x4")
    conflicts = roads.conflicts
    pairs = [
        (link, int(conflict["foe"]))
        for link, row in enumerate(roads.links)
        for conflict in conflicts[row["first_conflict"] :][: row["num_conflicts"]]
        if conflict["must_yield"]
    ]
    one, other = next((a, b) for a, b in pairs if (b, a) in pairs and a < b)
    steps = np.zeros(len(roads.lanes), PLAN)
    steps["next"] = steps["link"] = -1
    rows = np.concatenate([blank_vehicle(), blank_vehicle()])
    for row, link in zip(rows, (one, other), strict=True):
        lane = int(roads.links["from_lane"][link])
        steps["link"][lane], steps["next"][lane] = link, roads.links["next_lane"][link]
        row["id"], row["lane"], row["wait_s"], row["hold"] = link, lane, 30.0, HOLD_YIELD
        row["s"] = roads.lanes["length_m"][lane] - 3.0
    assert find_deadlocks(roads, steps, rows) == ((one, other),)


def test_an_environment_returns_its_deadlocks() -> None:
    with closing(parallel_env("grid4x4", agents=1, background=5)) as env:
        with pytest.raises(EpisodeError, match="before reset"):
            env.deadlocks()
        env.reset(seed=1)
        assert env.deadlocks() == ()
        with pytest.raises(ConfigError, match="world 1: must be from 0 to 0"):
            env.deadlocks(1)
