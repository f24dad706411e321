"""Invalid input raises a typed error with place and remedy, and does not change the world."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cavmarl import (
    ActionError,
    CapacityError,
    CavEnv,
    ConfigError,
    DemandError,
    EpisodeError,
    MapError,
    PolicyError,
    UnknownEnvironmentError,
    load_policy,
    make_vec,
    parallel_env,
)

FINE = np.zeros(2, dtype=np.float32)


def make(mode: str = "closed", **overrides: Any) -> CavEnv:
    env = parallel_env(
        "ring",
        agents=3,
        background=4,
        seed=0,
        overrides={
            "population.mode": mode,
            **{k.replace("__", "."): v for k, v in overrides.items()},
        },
    )
    env.reset()
    return env


def check_refused(env: CavEnv, actions: Any, error: type[Exception], *words: str) -> None:
    """Check that a step with `actions` raises an `error` with `words` and can be repeated."""
    before, stats, agents = env.state_hash(), env.traffic_stats(), list(env.agents)
    with pytest.raises(error) as caught:
        env.step(actions)
    for word in words:
        assert word in str(caught.value)
    assert isinstance(caught.value, ActionError)
    assert (env.state_hash(), env.traffic_stats(), env.agents) == (before, stats, agents)
    twin = make(env.config.population.mode, **{"action__kind": env.config.action.kind})
    fine = env.suggest_actions()
    assert twin.state_hash() == before
    env.step(fine)
    twin.step(fine)
    assert env.state_hash() == twin.state_hash(), "the refused step changed the world"


# Actions


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (np.array([0.0, np.nan]), ("car_1", "steering", "nan", "finite")),
        (np.array([np.inf, 0.0]), ("car_1", "throttle", "inf", "finite")),
        (np.array([-np.inf, 0.0]), ("car_1", "throttle", "finite")),
        (np.array([1e9, 0.0]), ("car_1", "throttle", "[-1, 1]", "clip")),
        (np.array([0.0, -1.001]), ("car_1", "steering", "-1.001", "[-1, 1]")),
        (np.zeros(3), ("car_1", "(3,)", "(2,)")),
        (np.zeros(1), ("car_1", "(1,)", "(2,)")),
        (np.zeros((1, 2)), ("car_1", "(1, 2)")),
        (np.zeros(()), ("car_1", "()", "(2,)")),
        (0.5, ("car_1", "()", "(2,)")),
        (None, ("car_1",)),
        ([], ("car_1", "(0,)", "(2,)")),
        ([[0.0], [0.0, 0.0]], ("car_1",)),
        (["a", "b"], ("car_1", "floats")),
        ("ab", ("car_1",)),
        (np.array([0.0, 0.0], dtype=object), ("car_1", "object", "floats")),
        (np.array([0j, 0j]), ("car_1", "complex", "floats")),
        (np.array([True, False]), ("car_1", "bool", "floats")),
        (np.array([1, 0]), ("car_1", "int64", "floats")),
        ({"throttle": 0.0}, ("car_1",)),
        ([10**400, 0], ("car_1",)),
    ],
    ids=repr,
)
def test_an_invalid_continuous_action_is_refused(value: Any, words: tuple[str, ...]) -> None:
    check_refused(make(), {"car_0": FINE, "car_1": value, "car_2": FINE}, ActionError, *words)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_all_float_types_are_accepted(dtype: type[np.generic]) -> None:
    env, twin = make(), make()
    env.step(dict.fromkeys(env.agents, np.array([1, 0], dtype=dtype)))
    twin.step(dict.fromkeys(twin.agents, np.array([1.0, 0.0])))
    assert env.state_hash() == twin.state_hash()


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (5, ("car_1", "5", "0 to 4")),
        (-1, ("car_1", "-1", "0 to 4")),
        (99, ("car_1", "99")),
        (2**63, ("car_1",)),
        (2**64, ("car_1",)),
        (1.0, ("car_1", "float", "whole")),
        (np.nan, ("car_1", "float", "whole")),
        (True, ("car_1", "bool", "whole")),
        ("3", ("car_1", "whole")),
        (None, ("car_1", "whole")),
        (np.array([1]), ("car_1", "(1,)")),
    ],
    ids=repr,
)
def test_an_invalid_discrete_action_is_refused(value: Any, words: tuple[str, ...]) -> None:
    env = make(action__kind="discrete")
    check_refused(env, {"car_0": 1, "car_1": value, "car_2": 1}, ActionError, *words)


def test_the_error_for_missing_actions_names_all_agents() -> None:
    check_refused(make(), {"car_1": FINE}, ActionError, "car_0, car_2", "missing_action")
    check_refused(make(), {}, ActionError, "car_0, car_1, car_2")


@pytest.mark.parametrize("stranger", ["car_3", "Car_0", "", 0, None, ("car_0",)])
def test_actions_for_unknown_agents_are_refused(stranger: Any) -> None:
    actions = {**dict.fromkeys(["car_0", "car_1", "car_2"], FINE), stranger: FINE}
    check_refused(make(), actions, ActionError, repr(stranger), "car_0", "car_2")


@pytest.mark.parametrize("actions", [None, [FINE] * 3, np.zeros((3, 2)), "car_0", 3])
def test_actions_that_are_not_a_dict_are_refused(actions: Any) -> None:
    check_refused(make(), actions, ActionError, "dict")


def drive_off_the_road(env: CavEnv) -> str:
    """Drive the agent `car_0` off the road; return its name."""
    while "car_0" in env.agents:
        actions = env.suggest_actions()
        actions["car_0"] = np.array([1.0, 1.0], np.float32)
        env.step(actions)
    assert env.agents
    return "car_0"


def test_actions_for_an_agent_that_has_left_are_refused() -> None:
    env = make()
    gone = drive_off_the_road(env)
    before = env.state_hash()
    with pytest.raises(ActionError, match=r"car_0.*not in the episode.*late_actions = ignore"):
        env.step({**env.suggest_actions(), gone: FINE})
    assert env.state_hash() == before


def test_late_actions_can_be_ignored_and_counted() -> None:
    env, twin = make(action__late_actions="ignore"), make()
    gone = drive_off_the_road(env)
    drive_off_the_road(twin)
    env.step({**env.suggest_actions(), gone: np.array([np.nan, 7.0])})
    twin.step(twin.suggest_actions())
    assert env.state_hash() == twin.state_hash()
    assert env.traffic_stats()["actions_ignored"] == 1
    with pytest.raises(ActionError):
        env.step({**env.suggest_actions(), "car_99": FINE})


def test_values_beyond_the_range_can_be_clipped_and_counted() -> None:
    env, twin = make(action__out_of_range="clip"), make()
    env.step({**env.suggest_actions(), "car_1": np.array([1e9, -2.0])})
    twin.step({**twin.suggest_actions(), "car_1": np.array([1.0, -1.0])})
    assert env.state_hash() == twin.state_hash()
    assert env.traffic_stats()["actions_clipped"] == 2
    before = env.state_hash()
    for value in (np.nan, np.inf):
        with pytest.raises(ActionError, match="finite"):
            env.step({**env.suggest_actions(), "car_1": np.array([value, 0.0])})
    assert env.state_hash() == before
    assert env.traffic_stats()["actions_clipped"] == 2


@pytest.mark.parametrize(
    ("kind", "first", "idle"), [("continuous", [0.5, 0.1], [0.0, 0.0]), ("discrete", 3, 1)]
)
def test_missing_actions_can_repeat_the_last_ones_and_are_counted(
    kind: str, first: Any, idle: Any
) -> None:
    env = make(action__missing_action="hold", action__kind=kind)
    twin = make(action__kind=kind)
    for given in ({"car_1": first}, {}, {"car_0": first}):
        env.step(given)
    car_0, car_1, car_2 = env.possible_agents
    for one, other in ((idle, first), (idle, first), (first, first)):
        twin.step({car_0: one, car_1: other, car_2: idle})
    assert env.state_hash() == twin.state_hash()
    assert env.traffic_stats()["actions_held"] == 2 + 3 + 2
    env.reset(seed=0)
    twin.reset(seed=0)
    env.step({})
    twin.step(dict.fromkeys(twin.agents, idle))
    assert env.state_hash() == twin.state_hash(), "an action of the previous episode was held"


# Calls before, in and after an episode


def test_step_and_render_before_reset_are_refused() -> None:
    env = parallel_env("ring", render_mode="rgb_array")
    for call in (lambda: env.step({"car_0": FINE}), lambda: env.step({}), env.render):
        with pytest.raises(EpisodeError, match=r"reset\(seed"):
            call()
    with pytest.raises(EpisodeError, match=r"reset\(seed"):
        make_vec("ring").step(np.zeros((1, 4, 2)))


def test_a_lenient_world_accepts_and_counts_actions_of_libraries() -> None:
    """With `lenient`, values are clipped, missing actions repeated and late actions ignored."""
    env = parallel_env("ring", agents=2, background=0, seed=0, max_cycles=3, lenient=True)
    strict = parallel_env("ring", agents=2, background=0, seed=0, max_cycles=3)
    env.reset()
    strict.reset()
    env.step({"car_0": np.array([9.0, 0.0])})
    strict.step({"car_0": np.array([1.0, 0.0]), "car_1": np.zeros(2)})
    assert env.state_hash() == strict.state_hash()
    env.step({agent: np.array([0.0, -1.0]) for agent in env.possible_agents})
    tolerated = {name: count for name, count in env.traffic_stats().items() if "actions_" in name}
    assert tolerated == {"actions_clipped": 1, "actions_held": 1, "actions_ignored": 0}
    env.step({})
    assert env.step({"car_0": FINE}) == ({}, {}, {}, {}, {})
    env.reset()
    with pytest.raises(ActionError, match="must be finite"):
        env.step({"car_0": np.array([np.nan, 0.0])})


def test_actions_after_the_end_are_refused() -> None:
    env = parallel_env("ring", agents=2, background=0, seed=0, max_cycles=2)
    env.reset()
    for _ in range(2):
        env.step(env.suggest_actions())
    before = env.state_hash()
    with pytest.raises(EpisodeError, match=r"env\.reset\(\)"):
        env.step({"car_0": FINE})
    assert env.step({}) == ({}, {}, {}, {}, {})
    assert env.state_hash() == before


def test_render_without_a_mode_warns() -> None:
    with pytest.warns(UserWarning, match="without a render_mode"):
        assert make().render() is None


@pytest.mark.parametrize("seed", [-1, 2**63, 1.5, "0", True, np.nan, [1]])
def test_invalid_seeds_are_refused(seed: Any) -> None:
    env, vec = make(), make_vec("ring")
    before = env.state_hash()
    for call in (env.reset, vec.reset):
        with pytest.raises(ConfigError, match="seed"):
            call(seed=seed)
    assert env.state_hash() == before
    with pytest.raises(ConfigError, match="seed"):
        parallel_env("ring", seed=seed).reset()


# Vectorized environments


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        (np.zeros((1, 3, 2)), ("(1, 3, 2)", "(2, 3, 2)", "num_envs")),
        (np.zeros((3, 3, 2)), ("(3, 3, 2)", "(2, 3, 2)")),
        (np.zeros((2, 4, 2)), ("(2, 4, 2)",)),
        (np.zeros((2, 3)), ("(2, 3)",)),
        (np.zeros((2, 3, 3)), ("(2, 3, 3)",)),
        (np.zeros(()), ("()",)),
        (None, ("floats",)),
        ({"car_0": FINE}, ("floats",)),
        ([[1.0], [1.0, 2.0]], ("floats",)),
        (np.zeros((2, 3, 2), dtype=complex), ("complex", "floats")),
        (np.zeros((2, 3, 2), dtype=bool), ("bool", "floats")),
        (np.full((2, 3, 2), np.nan), ("world 0", "car_0", "throttle", "finite")),
        (np.full((2, 3, 2), 1.5), ("world 0", "car_0", "[-1, 1]")),
    ],
    ids=lambda value: str(getattr(value, "shape", value)),
)
def test_invalid_arrays_are_refused_before_any_world_moves(
    actions: Any, words: tuple[str, ...]
) -> None:
    vec = make_vec("ring", num_envs=2, agents=3, background=4, seed=0)
    vec.reset()
    before = [vec.state_hash(world) for world in range(2)]
    with pytest.raises(ActionError) as caught:
        vec.step(actions)
    for word in words:
        assert word in str(caught.value)
    assert [vec.state_hash(world) for world in range(2)] == before
    vec.step(vec.suggest_actions())


def test_the_error_names_the_world_of_an_invalid_value() -> None:
    vec = make_vec("ring", num_envs=3, agents=3, background=0, seed=0)
    vec.reset()
    actions = np.zeros((3, 3, 2))
    actions[2, 1, 1] = np.inf
    with pytest.raises(ActionError, match="world 2, car_1, steering"):
        vec.step(actions)


@pytest.mark.parametrize("num_envs", [0, -1, 65_537, 1.5, "2", None, True])
def test_an_invalid_number_of_worlds_is_refused(num_envs: Any) -> None:
    with pytest.raises(ConfigError, match="num_envs"):
        make_vec("ring", num_envs=num_envs)


# Configuration


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"agents": 0}, ("population.agents", "0", "at least one agent")),
        ({"agents": -3}, ("population.agents", "-3")),
        ({"agents": 2.5}, ("population.agents", "2.5")),
        ({"agents": True}, ("population.agents", "True")),
        ({"background": -1}, ("population.background", "-1")),
        ({"background": "many"}, ("population.background", "many")),
        ({"zones": 0}, ("zones.count", "0", "1 to 256")),
        ({"workers": 2}, ("workers = 2", "more zones")),
        ({"workers": -1}, ("workers = -1", "from 0")),
        ({"max_cycles": 0}, ("max_cycles", "0")),
        ({"max_cycles": -5}, ("max_cycles", "-5")),
        ({"max_cycles": 1.5}, ("max_cycles", "1.5")),
        ({"max_cycles": float("nan")}, ("max_cycles", "nan")),
        ({"render_mode": "ascii"}, ("render_mode", "ascii", "rgb_array")),
        ({"overrides": {"sensors.lidar.ray": 3}}, ("sensors.lidar.ray", "sensors.lidar.rays")),
        ({"overrides": {"sensor.lidar.rays": 3}}, ("sensor", "sensors")),
        ({"overrides": {"sensors.lidar.range_km": 1.0}}, ("range_km", "range_m", "unit")),
        ({"overrides": {"lidar.rays": 3}}, ("lidar",)),
        ({"overrides": {"sensors.lidar.rays": -1}}, ("sensors.lidar.rays", "-1", "0 to 1024")),
        ({"overrides": {"sensors.lidar.rays": "64"}}, ("sensors.lidar.rays", "64")),
        ({"overrides": {"horizon_s": float("nan")}}, ("horizon_s", "nan")),
        ({"overrides": {"horizon_s": float("inf")}}, ("horizon_s",)),
        ({"overrides": {"horizon_s": -1.0}}, ("horizon_s", "-1")),
        ({"overrides": {"clock.sim_dt_s": 0.0}}, ("clock.sim_dt_s", "0.001")),
        ({"overrides": {"clock.ctrl_dt_s": 0.12}}, ("clock.ctrl_dt_s", "0.12", "0.05", "try 0.1")),
        ({"overrides": {"clock.control_latency_ticks": 17}}, ("control_latency_ticks", "0 to 16")),
        ({"overrides": {"population.mode": "opened"}}, ("population.mode", "closed", "respawn")),
        (
            {"overrides": {"population.mode": "open", "population.budget": 1}, "agents": 2},
            ("population.budget", "1", "2"),
        ),
        (
            {"overrides": {"population.mode": "open", "population.budget": 2**40}},
            ("population.budget", "1000000"),
        ),
        (
            {"overrides": {"terms.weights": {"speeeding": 1.0}}},
            ("terms.weights", "speeeding", "speeding"),
        ),
        ({"overrides": {"terms.weights": {"speeding": float("inf")}}}, ("terms.weights",)),
        ({"overrides": {"traffic.min_trip_m": 1e5}}, ("traffic.min_trip_m", "longest route")),
        ({"overrides": {"traffic.origins": ["nowhere"]}}, ("traffic.origins", "nowhere")),
        ({"overrides": {"traffic.destinations": ["x"]}}, ("traffic.destinations", "x")),
        ({"agents": 3, "overrides": {"population.agents": 4}}, ("population.agents", "keyword")),
    ],
    ids=repr,
)
def test_an_invalid_world_is_refused(arguments: dict[str, Any], words: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError) as caught:
        parallel_env("ring", **arguments)
    for word in words:
        assert word in str(caught.value)


def test_more_agents_than_the_map_has_room_for_are_refused() -> None:
    with pytest.raises(CapacityError, match=r"= 500.*room for \d+ vehicles"):
        parallel_env("ring", agents=500, background=0)
    with pytest.raises(CapacityError, match=r"= 3004.*room for \d+ vehicles"):
        parallel_env("ring", background=3000)
    env = parallel_env("ring", agents=90, background=0, seed=0)
    with pytest.raises(CapacityError, match=r"population\.agents = 90.*population\.mode"):
        env.reset()
    with pytest.raises(EpisodeError):
        env.step({})


def test_the_error_for_an_unknown_environment_lists_environments() -> None:
    with pytest.raises(UnknownEnvironmentError, match=r"mreg.*did you mean merge"):
        parallel_env("mreg")


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", "", "\ud800"])
def test_names_that_are_not_valid_file_names_are_refused(name: str) -> None:
    with pytest.raises(UnknownEnvironmentError):
        parallel_env(name)
    with pytest.raises(PolicyError):  # "" names the working directory
        load_policy(name, parallel_env("ring"))
    with pytest.raises((MapError, ConfigError), match=r"map\.source|not allowed"):
        parallel_env("ring", overrides={"map.source": f"{name}.net.xml"})
    with pytest.raises((DemandError, ConfigError), match=r"traffic\.demand|not allowed"):
        parallel_env("ring", overrides={"traffic.demand": [f"{name}.rou.xml"]})
