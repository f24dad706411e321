"""Signals as a driving stack knows them: from the world, or from received messages."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.core.records.codes import SIGNAL_NONE, SIGNAL_RED
from cavmarl.cosim.followers.follower_client import sight_of
from cavmarl.cosim.followers.follower_snapshots import SnapshotTime, take_snapshot
from cavmarl.cosim.stack.hd_map import HdMap
from cavmarl.cosim.stack.signal_reading import SPAT, SpatSignals, ToldSignals

AIR = {"v2x.enabled": True, "v2x.roadside.signals": ["all"], "v2x.inbox.signals": 64}


def looks(workers: int = 0, **more: Any) -> list[tuple[Any, Any, cavmarl.CavEnv]]:
    """Return the received and the true signal states of car_0, over some steps."""
    env = cavmarl.parallel_env(
        "grid4x4", agents=2, background=0, workers=workers, overrides=AIR | more
    )
    try:
        env.reset(seed=0)
        found = []
        for step in range(30):
            moment = SnapshotTime(step, 0, int(env.worlds.ticks()[0]), False)
            sight = sight_of(*take_snapshot(env, [0], moment))
            told = sight.sensors[""]["signals"].values[-1]
            found.append((sight.sensors["car_0"], told, env))
            env.step(env.suggest_actions())
        return found
    finally:
        env.close()


def test_received_signal_states_equal_the_signals() -> None:
    found = looks()
    stage = SpatSignals(HdMap(found[0][2].network))
    seen = set()
    equal = 0
    for (_, before, _), (readings, told, _) in pairwise(found[1:]):
        heard = stage.read(readings, None)
        assert ((heard == told) | (heard == before)).all()  # a message is one or two ticks old
        equal += int((heard == told).all())
        assert ToldSignals().read({}, told) is told
        seen |= set(told[told != SIGNAL_NONE].tolist())
    assert len(seen) > 1  # both red and green occurred
    assert equal > 0.6 * len(found)


def test_received_states_are_equal_on_workers() -> None:
    for (mine, *_), (theirs, *_) in zip(looks(), looks(workers=1), strict=True):
        assert (mine[SPAT].values == theirs[SPAT].values).all()


def test_a_signal_that_is_not_heard_is_red() -> None:
    found = looks(**{"v2x.channel.loss": 1.0})
    network = found[0][2].network
    stage = SpatSignals(HdMap(network))
    heard = stage.read(found[-1][0], found[-1][1])
    has_one = network.links["signal"] >= 0
    assert has_one.any()
    assert (heard[has_one] == SIGNAL_RED).all()
    assert (heard[~has_one] == SIGNAL_NONE).all()
    assert (stage.read({}, None) == heard).all()


def test_signals_out_of_reach_are_red_and_near_signals_are_received() -> None:
    found = looks(**{"v2x.channel.range_m": 150.0})
    readings, told, env = found[-1]
    heard = SpatSignals(HdMap(env.network)).read(readings, None)
    near = np.isin(env.network.links["signal"], readings[SPAT].values[-1][:, 0])
    assert 0 < near.sum() < (told != SIGNAL_NONE).sum()
    assert ((heard[near] == told[near]) | (heard[near] == found[-2][1][near])).all()
    assert (heard[(told != SIGNAL_NONE) & ~near] == SIGNAL_RED).all()


def test_without_messages_there_is_no_spat() -> None:
    readings = looks(**{"v2x.enabled": False, "v2x.roadside.signals": []})[-1][0]
    assert SPAT not in readings


@pytest.mark.parametrize("stage", ["told", "spat"])
def test_the_stack_stops_at_red_with_each(stage: str) -> None:
    """If a signal has no state, `spat` makes the stack stop, and `told` uses the right of way."""
    from cavmarl.config.registry import load_config
    from cavmarl.cosim.stack.route_planning import LaneRoute
    from cavmarl.cosim.stack.stack_types import EgoPose, Mission
    from cavmarl.engine.world_setup import load_roads

    grid = HdMap(load_roads(*load_config("grid4x4")))
    network = grid.network
    link = int(np.flatnonzero(network.links["signal"] >= 0)[0])
    lane = int(network.links["from_lane"][link])
    goal = int(network.lanes["edge"][network.links["to_lane"][link]])
    (x, y), *_ = grid.polyline(lane, float(network.lanes["length_m"][lane]) - 20.0).tolist()
    pose = EgoPose(x, y, grid.on_lane(lane, x, y).heading_rad, 10.0)
    shown = {"told": ToldSignals(), "spat": SpatSignals(grid)}[stage].read({}, None)
    plan = LaneRoute(grid).plan(pose, [], shown, Mission(goal, "passenger", 5.0, 2.0))
    assert plan.reason == ("stop_line" if stage == "spat" else "free")
