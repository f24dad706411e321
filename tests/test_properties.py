"""Random input either works, or raises an error of cavmarl and changes nothing."""

from __future__ import annotations

import json
import types
from collections.abc import Mapping
from contextlib import chdir
from dataclasses import fields, is_dataclass
from tempfile import TemporaryDirectory
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from cavmarl import CavEnv, CavVectorEnv, make_vec, parallel_env
from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ActionError, CavmarlError, EpisodeError

# Configurations

NONSENSE: list[Any] = [None, "", "x", "\x00", "4", [], {}, [[]], b"4", True, -1, 0, 1, 10**30]
NONSENSE += [float("nan"), float("inf"), -0.0, 1e308, 5e-324, np.float32(3), np.int8(-1), object()]
CIRCLE: list[Any] = []
CIRCLE.append(CIRCLE)
NONSENSE += [
    CIRCLE,
    {("a", 1): 2},
    {1: 2},
    {"a": b"b"},
    json.loads("[" * 900 + "]" * 900),
    "\ud800",
]
WHOLE = [0, 1, 2, 3, 16, 17, 64, 65, 256, 257, 1024, 1025, 2048, 65_536, 2**31, 2**63, 2**64]
NUMBERS = [0.0, 1e-9, 0.001, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 10.0, 60.0, 300.0, 300.1, 1e6, 1e7]


def values(hint: Any) -> st.SearchStrategy[Any]:
    """Return a strategy for values of a field's type, with likely limits among them."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return st.sampled_from(arguments)
    if origin in (Union, types.UnionType):
        return st.one_of(*map(values, arguments))
    if origin is tuple:
        return st.lists(values(arguments[0]), max_size=4)
    if origin is dict:
        return st.dictionaries(*map(values, arguments), max_size=3)
    if is_dataclass(hint):
        hints = get_type_hints(hint)
        keys = {field.name: values(hints[field.name]) for field in fields(hint)}
        needed = {name: keys.pop(name) for name in ("type", "rate_hz") if name in keys}
        if "rate_hz" in needed:
            needed["rate_hz"] |= st.sampled_from([1.0, 10.0, 20.0])
        return st.fixed_dictionaries(needed, optional=keys)
    plain: dict[Any, st.SearchStrategy[Any]] = {
        bool: st.booleans(),
        int: st.sampled_from(WHOLE) | st.integers(-3, 70),
        float: st.sampled_from(NUMBERS) | st.floats(-1.0, 400.0),
        str: st.sampled_from(["x", "vx", "presence", "speed", "e0", "off", "map/map.net.xml"])
        | st.text(max_size=5),
        type(None): st.none(),
    }
    return plain[hint]


def settings_of(kind: type[Any], prefix: str = "") -> dict[str, st.SearchStrategy[Any]]:
    """Return a strategy for the values of each dotted key of a configuration class."""
    found: dict[str, st.SearchStrategy[Any]] = {}
    hints = get_type_hints(kind)
    for field in fields(kind):
        hint, key = hints[field.name], f"{prefix}{field.name}"
        if is_dataclass(hint):
            found |= settings_of(hint, f"{key}.")  # type: ignore[arg-type]
        else:
            found[key] = values(hint)
    return found


SETTINGS = settings_of(EnvConfig)
NEAR = st.sampled_from(sorted(SETTINGS)).flatmap(
    lambda key: st.tuples(st.just(key), SETTINGS[key] | st.sampled_from(NONSENSE))
)
STRANGE = st.tuples(
    st.sampled_from(["", ".", "sensors", "sensors.", "sensors.lidar", "sensors.lidar.rays.x", "é"])
    | st.text(max_size=8),
    st.sampled_from(NONSENSE),
)
SMALL = {"population.agents": 2, "population.background": 2}


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(pairs=st.lists(NEAR | NEAR | NEAR | STRANGE, min_size=1, max_size=3))
def test_any_configuration_makes_a_world_or_is_refused(pairs: list[tuple[str, Any]]) -> None:
    with TemporaryDirectory() as room, chdir(room):  # journals are written there
        try:
            env = parallel_env("ring", seed=0, overrides=SMALL | dict(pairs))
            observations, _ = env.reset()
        except CavmarlError:
            return
        for _ in range(2):
            for agent, seen in observations.items():
                assert env.observation_space(agent).contains(seen)
            if env.agents:
                observations, *_ = env.step(env.suggest_actions())


# Actions

ANYTHING = st.one_of(
    st.sampled_from(NONSENSE),
    st.binary(max_size=9),
    st.text(max_size=3),
    st.lists(st.floats() | st.integers(), max_size=3),
    npst.arrays(npst.scalar_dtypes(), npst.array_shapes(min_dims=0, max_dims=2, max_side=3)),
    npst.arrays(np.float64, 2),
)
PAIRS = npst.arrays(np.float32, 2, elements=st.floats(-1, 1, width=32))
MOVES = st.integers(-1, 5)
AGENTS = ["car_0", "car_1", "car_2"]
STRANGERS = st.sampled_from(["car_3", "", None, 0, ("car_0",), 1.5])


def actions_of(fine: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    by_agent = st.fixed_dictionaries(
        {}, optional=dict.fromkeys(AGENTS, fine | fine | fine | ANYTHING)
    )
    strangers = st.dictionaries(STRANGERS, fine, max_size=1)
    both = st.tuples(by_agent, st.just({}) | strangers).map(lambda two: two[0] | two[1])
    return both | both | both | ANYTHING


@pytest.fixture(params=["strict", "lenient"], scope="module")
def leniency(request: pytest.FixtureRequest) -> dict[str, str]:
    if request.param == "strict":
        return {}
    return {
        "action.out_of_range": "clip",
        "action.missing_action": "hold",
        "action.late_actions": "ignore",
    }


@pytest.fixture(params=["continuous", "discrete"], scope="module")
def env(request: pytest.FixtureRequest, leniency: dict[str, str]) -> CavEnv:
    overrides = {"action.kind": request.param, "sensors.lidar.rays": 4, **leniency}
    return parallel_env("ring", agents=3, background=2, seed=0, max_cycles=20, overrides=overrides)


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_any_action_works_or_is_refused_without_effect(env: CavEnv, data: st.DataObject) -> None:
    if not env.agents:
        env.reset()
    fine = PAIRS if env.config.action.kind == "continuous" else MOVES
    actions = data.draw(actions_of(fine))
    before = env.state_hash(), env.traffic_stats(), list(env.agents)
    try:
        env.step(actions)
    except (ActionError, EpisodeError):
        assert (env.state_hash(), env.traffic_stats(), env.agents) == before
        return
    assert isinstance(actions, Mapping)
    assert env.state_hash() != before[0]


@pytest.fixture(params=["continuous", "discrete"], scope="module")
def vec(request: pytest.FixtureRequest, leniency: dict[str, str]) -> CavVectorEnv:
    overrides = {"action.kind": request.param, "sensors.lidar.rays": 4, **leniency}
    found = make_vec("ring", num_envs=2, agents=3, background=2, seed=0, overrides=overrides)
    found.reset()
    return found


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    actions=ANYTHING
    | npst.arrays(
        npst.floating_dtypes() | npst.integer_dtypes(), st.sampled_from([(2, 3, 2), (2, 3), (2,)])
    )
)
def test_any_array_works_or_is_refused_without_effect(vec: CavVectorEnv, actions: Any) -> None:
    before = [vec.state_hash(world) for world in range(2)]
    try:
        vec.step(actions)
    except ActionError:
        assert [vec.state_hash(world) for world in range(2)] == before
        return
    assert np.shape(actions)[:2] == (2, 3)


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(seed=ANYTHING)
def test_any_seed_works_or_is_refused_without_effect(env: CavEnv, seed: Any) -> None:
    env.reset(seed=0)
    before = env.state_hash()
    try:
        env.reset(seed=seed)
    except CavmarlError:
        assert env.state_hash() == before
