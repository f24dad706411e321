"""Messages about events that agents and roadside units declare."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cavmarl import make_vec, parallel_env
from cavmarl.core.errors import ActionError, ConfigError
from cavmarl.engine.spaces import observation_parts
from cavmarl.v2x.kernels.v2x_records import CAUSE_OBSTACLE, KIND_DENM
from cavmarl.v2x.v2x_messages import messages_of

TOLD = {
    "v2x.enabled": True,
    "v2x.denm.rate_hz": 0.0,
    "v2x.roadside.signals": ["all"],
    "sensors.messages.events": 1,
    "population.mode": "respawn",
}
PRESENT, OTHER = 0, 7  # indices of observed features


def run(workers: int, zones: int = 1, steps: int = 6) -> np.ndarray[Any, Any]:
    """Return observed events of a world in which agent 1 declares an obstacle in the third step."""
    env = make_vec("grid4x4", agents=4, workers=workers, zones=zones, overrides=TOLD)
    part = observation_parts(env.config.sensors)["messages"].place
    env.reset(seed=3)
    seen = []
    for step in range(steps):
        if step == 2:
            env.declare_event(0, 1, "obstacle")
        observations, *_ = env.step(env.suggest_actions())
        seen.append(observations[0, :, part])
    env.close()
    return np.array(seen)


def test_declared_events_reach_all_other_agents() -> None:
    seen = run(workers=0)
    assert (seen[:2] == 0.0).all()
    assert seen[2:, [0, 2, 3], PRESENT].all()
    assert seen[2:, [0, 2, 3], OTHER].all()
    assert not seen[:, 1].any()  # senders do not observe their events


def test_received_events_do_not_depend_on_workers_and_zones() -> None:
    whole = run(workers=0)
    assert (run(workers=2, zones=2) == whole).all()
    assert (run(workers=1) == whole).all()


def test_a_declared_event_is_sent_once_and_known_while_valid() -> None:
    overrides = TOLD | {"v2x.denm.validity_s": 0.4}
    env = make_vec("grid4x4", agents=2, overrides=overrides)
    env.reset(seed=3)
    env.declare_event(0, 0, "obstacle")
    bus = env.simulation.messages
    known = []
    for _ in range(4):
        env.step(env.suggest_actions())
        known.append(len(messages_of(KIND_DENM, bus.mail.events[0, 1])))
    assert bus.statistics().sent[KIND_DENM] == 1
    assert known == [1, 1, 0, 0]  # valid from tick 1 to 9; a step has 4 ticks


def test_a_roadside_unit_sends_and_receives_events() -> None:
    env = make_vec("grid4x4", agents=2, overrides=TOLD)
    env.reset(seed=3)
    bus = env.simulation.messages
    bus.declare_of_unit(0, 5, "obstacle")
    env.declare_event(0, 1, "hard_braking")
    env.step(env.suggest_actions())
    (heard,) = messages_of(KIND_DENM, bus.mail.events[0, 0, :1])
    assert heard["cause"] in (CAUSE_OBSTACLE, 99)
    at_unit = messages_of(KIND_DENM, bus.mail.events[0, bus.receiver_of_unit(5)])
    assert [event["cause"] for event in at_unit] == [99]
    with pytest.raises(ConfigError, match="roadside unit 16"):
        bus.declare_of_unit(0, 16, "obstacle")


def test_unknown_agents_and_causes_of_events_are_refused() -> None:
    env = parallel_env("grid4x4", overrides=TOLD)
    env.reset(seed=0)
    with pytest.raises(ActionError, match="car_99"):
        env.declare_event("car_99", "obstacle")
    with pytest.raises(ConfigError, match=r"'earthquake'.*obstacle"):
        env.declare_event(env.agents[0], "earthquake")
    silent = make_vec("ring")
    with pytest.raises(ConfigError, match=r"v2x\.enabled"):
        silent.declare_event(0, 0, "obstacle")
    with pytest.raises(ActionError, match="agent 99"):
        make_vec("grid4x4", overrides=TOLD).declare_event(0, 99, "obstacle")
