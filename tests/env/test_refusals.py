"""Calls that environments refuse: after close, before reset, and with wrong values."""

from __future__ import annotations

import re
from contextlib import closing
from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.core.errors import (
    ActionError,
    CavmarlError,
    ConfigError,
    EpisodeError,
    RegisteredFunctionError,
    UnknownArgumentError,
)
from cavmarl.core.extensions import REGISTERED_SENSORS, REGISTERED_TERMS

MAKERS: dict[str, Any] = {"parallel_env": cavmarl.parallel_env, "make_vec": cavmarl.make_vec}


@pytest.mark.parametrize("name", MAKERS)
def test_a_closed_environment_refuses_all_calls(name: str) -> None:
    env: Any = MAKERS[name]("ring", agents=2)
    env.reset(seed=0)
    actions = env.suggest_actions()
    env.close()
    env.close()
    for call in (env.reset, env.state, env.suggest_actions, lambda: env.step(actions)):
        with pytest.raises(EpisodeError, match=r"after close\(\): make another environment"):
            call()


@pytest.mark.parametrize("name", MAKERS)
def test_an_environment_before_its_first_reset_refuses_to_return_a_state(name: str) -> None:
    env: Any = MAKERS[name]("ring", agents=2)
    for call in (env.state, env.suggest_actions):
        with pytest.raises(EpisodeError, match=r"before reset\(\): call reset\(seed=…\) first"):
            call()
    env.close()


@pytest.mark.parametrize("name", MAKERS)
def test_the_error_for_an_unknown_argument_names_the_most_similar_argument(name: str) -> None:
    with pytest.raises(UnknownArgumentError, match=r"'num_agents': did you mean agents\?") as told:
        MAKERS[name]("ring", num_agents=3)
    assert isinstance(told.value, CavmarlError)
    assert isinstance(told.value, TypeError)
    assert isinstance(told.value, ConfigError)


@pytest.mark.parametrize("agent", ["x", 3, ["car_0"]])
def test_the_spaces_of_an_unknown_agent_are_refused(agent: Any) -> None:
    env = cavmarl.parallel_env("ring", agents=2)
    for space in (env.action_space, env.observation_space):
        with pytest.raises(ActionError, match=re.escape(f"no agent {agent!r}: the ids are car_0")):
            space(agent)
    assert env.action_space("car_1") is env.action_space("car_0")
    env.close()


@pytest.mark.parametrize("kind", [np.int64, np.int8, np.uint8, np.bool_])
def test_integer_arrays_are_refused_as_throttle_and_steering(kind: Any) -> None:
    message = rf"dtype is {np.dtype(kind)}; .*pass floats \(float32 or float64\)"
    env = cavmarl.parallel_env("ring", agents=2)
    env.reset(seed=0)
    with pytest.raises(ActionError, match=message):
        env.step({agent: np.zeros(2, kind) for agent in env.agents})
    env.step({agent: np.zeros(2, np.float64) for agent in env.agents})
    env.close()
    vec = cavmarl.make_vec("ring", agents=2)
    vec.reset(seed=0)
    with pytest.raises(ActionError, match=message):
        vec.step(np.zeros((1, 2, 2), kind))
    vec.close()


def drive(vec: cavmarl.CavVectorEnv) -> None:
    vec.reset(seed=0)
    vec.step(vec.suggest_actions())


@pytest.mark.parametrize("answer", ["fast", None, [1.0, "a"], [[1.0], [1.0, 2.0]]])
def test_a_registered_term_that_returns_no_finite_number_is_refused(answer: Any) -> None:
    def text(view: cavmarl.AgentView) -> Any:
        return answer

    cavmarl.register_term("text", text)
    try:
        vec = cavmarl.make_vec("ring", agents=1, overrides={"terms.weights": {"text": 1.0}})
        with pytest.raises(RegisteredFunctionError, match=r"'text' returned .*1 finite number"):
            drive(vec)
        vec.close()
    finally:
        REGISTERED_TERMS.remove("text")


@pytest.mark.parametrize("batched", [False, True])
def test_an_error_names_the_agent_whose_term_is_not_a_number(batched: bool) -> None:
    def bad(view: Any) -> Any:
        return np.where(view.own["agent"] == 6, -np.inf, 1.5)

    cavmarl.register_term("bad", bad, batched=batched)
    try:
        vec = cavmarl.make_vec("ring", agents=8, overrides={"terms.weights": {"bad": 1.0}})
        words = r"'bad' returned -inf for agent 6 \(vehicle \d+\); it must return 1 finite"
        with closing(vec), pytest.raises(RegisteredFunctionError, match=words):
            drive(vec)
    finally:
        REGISTERED_TERMS.remove("bad")


def test_an_error_names_the_index_of_a_sensor_value_that_is_not_a_number() -> None:
    def sense(view: Any) -> list[float]:
        return [0.0, float("nan")] if view.own["agent"] == 5 else [0.0, 1.0]

    features = [cavmarl.Feature(name, "a number") for name in ("one", "other")]
    cavmarl.register_sensor("bad", sense, features=features)
    try:
        vec = cavmarl.make_vec("ring", agents=8, overrides={"sensors.registered": ["bad"]})
        words = r"'bad' returned nan as number 1 for agent 5 "
        with closing(vec), pytest.raises(RegisteredFunctionError, match=words):
            drive(vec)
    finally:
        REGISTERED_SENSORS.remove("bad")
