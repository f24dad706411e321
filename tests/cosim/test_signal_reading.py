"""Signals that a driving stack reads from the world, or from received messages."""

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


def read_signals(workers: int = 0, **more: Any) -> list[tuple[Any, Any, cavmarl.CavEnv]]:
    """Step a world; return the sensors of car_0, the true signal states and the world, per step."""
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


def test_received_signal_states_equal_the_true_states() -> None:
    found = read_signals()
    stage = SpatSignals(HdMap(found[0][2].network))
    seen = set()
    equal = 0
    for (_, before, _), (readings, told, _) in pairwise(found[1:]):
        heard = stage.read(readings, None)
        assert (
            (heard == told) | (heard == before)
        ).all()  # the last message has the state of this step or of the previous one
        equal += int((heard == told).all())
        assert ToldSignals().read({}, told) is told
        seen |= set(told[told != SIGNAL_NONE].tolist())
    assert len(seen) > 1  # the signals change during the run
    assert equal > 0.6 * len(found)


def test_received_signal_states_are_equal_on_workers() -> None:
    for (mine, *_), (theirs, *_) in zip(read_signals(), read_signals(workers=1), strict=True):
        assert (mine[SPAT].values == theirs[SPAT].values).all()


def test_a_signal_without_received_messages_is_red() -> None:
    found = read_signals(**{"v2x.channel.loss": 1.0})
    network = found[0][2].network
    stage = SpatSignals(HdMap(network))
    heard = stage.read(found[-1][0], found[-1][1])
    has_one = network.links["signal"] >= 0
    assert has_one.any()
    assert (heard[has_one] == SIGNAL_RED).all()
    assert (heard[~has_one] == SIGNAL_NONE).all()
    assert (stage.read({}, None) == heard).all()


def test_signals_out_of_range_are_red_and_near_signals_are_received() -> None:
    found = read_signals(**{"v2x.channel.range_m": 150.0})
    readings, told, env = found[-1]
    heard = SpatSignals(HdMap(env.network)).read(readings, None)
    near = np.isin(env.network.links["signal"], readings[SPAT].values[-1][:, 0])
    assert 0 < near.sum() < (told != SIGNAL_NONE).sum()
    assert ((heard[near] == told[near]) | (heard[near] == found[-2][1][near])).all()
    assert (heard[(told != SIGNAL_NONE) & ~near] == SIGNAL_RED).all()


def test_without_messages_the_world_has_no_spat_sensor() -> None:
    readings = read_signals(**{"v2x.enabled": False, "v2x.roadside.signals": []})[-1][0]
    assert SPAT not in readings


@pytest.mark.parametrize("stage", ["told", "spat"])
def test_the_stage_spat_treats_an_unknown_state_as_red_and_the_stage_told_ignores_it(
    stage: str,
) -> None:
    """Plan towards a signal with no known state.

    With the stage `spat`, the stack stops; with `told`, it follows the right of way.
    """
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
