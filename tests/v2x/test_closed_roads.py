"""Roadside units send messages about closed roads."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np
import pytest

from cavmarl import make_vec
from cavmarl.sensors.observed import feature_names
from cavmarl.v2x.kernels.v2x_records import (
    CAUSE_ROAD_CLOSED,
    FIRST_CLOSED_ROAD,
    FIRST_ROADSIDE_ID,
    KIND_DENM,
)
from cavmarl.v2x.v2x_messages import messages_of

KEYS: dict[str, Any] = {
    "map.changed_lanes": 8,
    "v2x.enabled": True,
    "v2x.roadside.signals": ["all"],
    "sensors.messages.events": 4,
}
CLOSED = ("B1B2", "B2B1")


def close(env: Any, step: int) -> None:
    if step == 5:
        for edge in CLOSED:
            env.close_road(edge)
    if step == 60:
        env.open_road("B2B1")


def known_closed_roads(vec: Any, agent: int) -> set[str]:
    """Return the closed roads in the inbox of an agent."""
    box = vec.simulation.messages.mail.events[0, agent]
    rows = box[(box["sender"] >= 0) & (box["code"] == CAUSE_ROAD_CLOSED)]
    return {vec.network.edge_ids[row] for row in (rows["subject"] - FIRST_CLOSED_ROAD).tolist()}


def test_agents_know_closed_roads_from_messages_until_they_open() -> None:
    with closing(make_vec("grid4x4", agents=2, background=10, overrides=KEYS)) as vec:
        vec.reset(seed=1)
        heard: list[set[str]] = []
        for step in range(100):
            close(vec, step)
            observations = vec.step(vec.suggest_actions())[0]
            heard.append(known_closed_roads(vec, 0))
            if step == 30:
                box = vec.simulation.messages.mail.events[0, 0]
                seen = observations[0, 0]
        assert heard[4] == set()
        assert heard[30] == set(CLOSED)
        assert heard[99] == {"B1B2"}
    told = messages_of(KIND_DENM, box)
    told = told[told["cause"] == CAUSE_ROAD_CLOSED]
    assert (told["sender"] >= FIRST_ROADSIDE_ID).all()
    network = vec.network
    for row in told:
        lanes = [network.lane_ids.index(f"{edge}_0") for edge in CLOSED]
        begins = network.points[network.lanes["first_point"][lanes]]
        away_m = np.hypot(begins["x"] - row["x"], begins["y"] - row["y"])
        assert away_m.min() < 1e-9
        assert row["heading"] == begins["heading"][away_m.argmin()]
    names = feature_names(vec.config.sensors)
    assert seen[names.index(("messages", "event_other_0"))] == 1.0


def test_roadside_units_report_only_nearby_roads() -> None:
    with closing(make_vec("grid4x4", agents=1, background=5, overrides=KEYS)) as vec:
        vec.reset(seed=1)
        senders: set[int] = set()

        def watch(world: int, tick: int, packets: Any, reports: Any) -> None:
            is_closed = (reports["code"] == CAUSE_ROAD_CLOSED) & (reports["kind"] == KIND_DENM)
            senders.update(reports["sender"][is_closed].tolist())

        vec.simulation.messages.watch(watch)
        vec.close_road("A0left0")
        for _ in range(20):
            vec.step(vec.suggest_actions())
        units = vec.simulation.messages.units
        begin = vec.network.points[
            vec.network.lanes["first_point"][vec.network.lane_ids.index("A0left0_0")]
        ]
        near = np.hypot(units["x"] - begin["x"], units["y"] - begin["y"]) <= 500.0
        assert senders == set((FIRST_ROADSIDE_ID + np.flatnonzero(near)).tolist())


def hashes(act: Any = close, **more: Any) -> list[str]:
    with closing(make_vec("grid4x4", agents=3, background=20, overrides=KEYS, **more)) as vec:
        vec.reset(seed=2)
        found = []
        for step in range(80):
            act(vec, step)
            vec.step(vec.suggest_actions())
            if step % 20 == 19:
                found.append(vec.state_hash())
        return found


def test_a_divided_world_with_closed_roads_equals_the_undivided_one() -> None:
    undivided = hashes()
    assert hashes(zones=4) == undivided
    assert hashes(zones=4, workers=2) == undivided


@pytest.mark.slow
def test_a_world_with_closed_roads_over_nodes_equals_the_undivided_one() -> None:
    assert hashes(zones=2, nodes=2) == hashes()


def test_a_saved_state_keeps_messages_about_closed_roads() -> None:
    with closing(make_vec("grid4x4", agents=3, background=20, overrides=KEYS)) as vec:
        vec.reset(seed=2)
        for step in range(80):
            close(vec, step)
            if step == 31:
                saved = vec.save_state()
            vec.step(vec.suggest_actions())
        wanted = vec.state_hash()
    with closing(make_vec("grid4x4", agents=3, background=20, overrides=KEYS, zones=2)) as vec:
        vec.reset(seed=5)
        vec.load_state(saved)
        for step in range(31, 80):
            close(vec, step)
            vec.step(vec.suggest_actions())
        assert vec.state_hash() == wanted
