"""Extensions that users register; their results do not depend on zones and backends.

The files are the examples of docs/guides/extending.md.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.core.errors import ConfigError, RegisteredFunctionError
from cavmarl.core.extensions import REGISTERED_MODELS, REGISTERED_SENSORS, REGISTERED_TERMS
from cavmarl.sensors.registry import sensor_names

PAGE = Path(__file__).resolve().parents[1] / "docs" / "guides" / "extending.md"
ENV, AGENTS, BACKGROUND, STEPS = "grid4x4", 12, 40, 40
KINDS = ("A term", "A sensor", "A driver model", "A backend")


@pytest.fixture(scope="module")
def examples(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, ModuleType]]:
    """Import the code of each section of the page as a module; yield the modules by heading."""
    folder = tmp_path_factory.mktemp("outside")
    sys.path.insert(0, str(folder))
    found = {}
    for section in PAGE.read_text(encoding="utf-8").split("\n## ")[1:]:
        if blocks := re.findall(r"```python\n(.*?)```", section, re.DOTALL):
            title = section.splitlines()[0]
            name = "outside_" + title.lower().replace(" ", "_")
            (folder / f"{name}.py").write_text("\n\n".join(blocks), encoding="utf-8")
            found[title] = importlib.import_module(name)
    assert tuple(found) == KINDS
    yield found
    sys.path.remove(str(folder))
    for registry in (REGISTERED_TERMS, REGISTERED_SENSORS, REGISTERED_MODELS):
        for name in registry.names:
            registry.remove(name)


def run(overrides: dict[str, Any], **how: Any) -> tuple[list[bytes], list[str], np.ndarray, Any]:
    """Run worlds; return bytes of each step, hashes, sums of terms and the last observations."""
    vec = cavmarl.make_vec(
        ENV, num_envs=2, agents=AGENTS, background=BACKGROUND, overrides=overrides, **how
    )
    rng = np.random.default_rng(3)
    try:
        observations, infos = vec.reset(seed=5)
        seen = [observations.tobytes()]
        summed = np.zeros(len(vec.config.terms.names))
        for _ in range(STEPS):
            actions = rng.uniform(-0.2, 0.6, vec.action_space.shape).astype(np.float32)
            actions[..., 1] *= 0.05
            observations, rewards, ended, cut, infos = vec.step(actions)
            parts = (observations, rewards, ended, cut, infos["terms"])
            seen.append(b"".join(np.ascontiguousarray(part).tobytes() for part in parts))
            summed += np.abs(infos["terms"]).sum(axis=(0, 1))
        return seen, [vec.state_hash(w) for w in range(2)], summed, observations
    finally:
        vec.close()


def same_bytes(overrides: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Compare one zone, four zones and two workers; return sums of terms and observations."""
    whole = run(overrides)
    for how in ({"zones": 4}, {"zones": 4, "workers": 2}):
        divided = run(overrides, **how)
        assert divided[:2] == whole[:2], how
    return whole[2], whole[3]


def test_a_registered_term_is_part_of_the_reward_terms(examples: dict[str, ModuleType]) -> None:
    weights = {"progress": 0.1, "headway": -0.5}
    terms, _ = same_bytes({"terms.weights": weights})
    assert terms.shape == (len(cavmarl.TERMS) + 1,)
    assert terms[-1] > 0.0
    env = cavmarl.parallel_env(ENV, agents=2, overrides={"terms.weights": weights})
    env.reset(seed=0)
    *_, infos = env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    assert all("headway" in info for info in infos.values())
    env.close()


def test_a_batched_term_equals_the_same_term_of_single_agents(
    examples: dict[str, ModuleType],
) -> None:
    weights = {"headway": -0.5, "headway_of_all": -0.25}
    terms, _ = same_bytes({"terms.weights": weights})
    assert terms[-1] == terms[-2] > 0.0


def test_a_batched_term_that_depends_on_other_agents_is_refused() -> None:
    def against_the_mean(view: cavmarl.BatchView) -> np.ndarray:
        return view.own["speed"] - view.own["speed"].mean()

    cavmarl.register_term("relative", against_the_mean, reach_m=300.0, batched=True)
    env = cavmarl.parallel_env(ENV, agents=4, overrides={"terms.weights": {"relative": 1.0}})
    with pytest.raises(RegisteredFunctionError, match=r"'relative' depends on .* of the batch"):
        drive(env)
    env.close()


def test_workers_need_only_the_extensions_of_their_worlds() -> None:
    """A notebook can make worlds in workers that do not use the notebook's term."""

    def zero(view: cavmarl.AgentView) -> float:
        return 0.0

    zero.__module__ = "a_page_of_a_notebook"
    cavmarl.register_term("zero", zero)
    cavmarl.make_vec("ring", num_envs=2, workers=1).close()
    with pytest.raises(ConfigError, match=r"'zero' is registered in 'a_page_of_a_notebook'"):
        cavmarl.make_vec("ring", workers=1, overrides={"terms.weights": {"zero": 1.0}})
    REGISTERED_TERMS.remove("zero")


def test_a_batched_function_must_return_a_number_for_each_agent() -> None:
    cavmarl.register_term("one", lambda view: np.zeros(1), batched=True)
    env = cavmarl.parallel_env(ENV, agents=4, overrides={"terms.weights": {"one": 1.0}})
    with pytest.raises(
        RegisteredFunctionError, match=r"'one' .* must return 1 finite number\(s\) per"
    ):
        drive(env)
    env.close()


def test_a_registered_sensor_is_observed_last(examples: dict[str, ModuleType]) -> None:
    _, seen = same_bytes({"sensors.registered": ["crowd"]})
    assert np.abs(seen[..., -2:]).sum() > 0.0, "the last features are zero"
    assert "crowd" in sensor_names()
    assert REGISTERED_SENSORS["crowd"].name == "crowd"
    with pytest.raises(ConfigError, match=r"cavmarl\.register_sensor"):
        REGISTERED_SENSORS["cloud"]


def test_a_registered_driver_model_differs_from_all_other_models(
    examples: dict[str, ModuleType],
) -> None:
    whole = run({"traffic.model": "relaxed"})
    same_bytes({"traffic.model": "relaxed"})
    others = [run({"traffic.model": model})[1] for model in ("IDM", "Krauss", "ACC")]
    hashes = [whole[1], *others]
    assert len({tuple(one) for one in hashes}) == len(hashes), (
        "two driver models give equal results"
    )


def test_a_registered_backend_gives_the_same_results(examples: dict[str, ModuleType]) -> None:
    assert run({}, backend="at_most_two")[:2] == run({})[:2]


def test_a_registered_sensor_is_called_in_every_step() -> None:
    """The observation has the numbers of the present step."""

    def parity(view: cavmarl.AgentView) -> float:
        return float(view.own["tick"] % 7) / 7.0

    cavmarl.register_sensor("parity", parity, features=[cavmarl.Feature("tick", "tick modulo 7")])
    env = cavmarl.parallel_env(ENV, agents=1, overrides={"sensors.registered": ["parity"]})
    seen = [env.reset(seed=0)[0]["car_0"][-1]]
    for _ in range(3):
        seen.append(env.step({"car_0": np.zeros(2, np.float32)})[0]["car_0"][-1])
    env.close()
    per_step = env.config.clock.ticks_per_step
    expected = [np.float32((k * per_step) % 7 / 7.0) for k in range(4)]
    assert seen == expected


def drive(env: cavmarl.CavEnv) -> None:
    """Reset an environment and run three steps."""
    env.reset(seed=0)
    for _ in range(3):
        env.step({agent: np.zeros(2, np.float32) for agent in env.agents})


def test_functions_that_depend_on_the_order_of_vehicles_are_refused() -> None:
    def first(view: cavmarl.AgentView) -> float:
        return float(view.others["x"][0]) if view.others.size else 0.0

    cavmarl.register_term("first", first, reach_m=300.0)
    env = cavmarl.parallel_env(ENV, agents=2, overrides={"terms.weights": {"first": 1.0}})
    with pytest.raises(RegisteredFunctionError, match=r"'first' depends on the order"):
        drive(env)
    env.close()


def test_unknown_and_used_names_are_refused() -> None:
    def nothing(view: Any) -> float:
        return 0.0

    with pytest.raises(ConfigError, match=r"traffic.model = 'IDN' is not a driver model"):
        cavmarl.parallel_env(ENV, overrides={"traffic.model": "IDN"})
    with pytest.raises(ConfigError, match=r"no such term.*cavmarl.register_term"):
        cavmarl.parallel_env(ENV, overrides={"terms.weights": {"headwind": 1.0}})
    with pytest.raises(ConfigError, match=r"cavmarl.register_sensor"):
        cavmarl.parallel_env(ENV, overrides={"sensors.registered": ["nose"]})
    with pytest.raises(ConfigError, match=r"backend = 'moon': there is no backend"):
        cavmarl.parallel_env(ENV, backend="moon")
    with pytest.raises(ConfigError, match="cavmarl has this name"):
        cavmarl.register_term("speeding", nothing)
    with pytest.raises(ConfigError, match="cavmarl has this name"):
        cavmarl.register_sensor("lidar", nothing, features=[cavmarl.Feature("a", "b")])
    with pytest.raises(ConfigError, match="cavmarl has this name"):
        cavmarl.register_driver_model("EIDM", nothing)
    with pytest.raises(ConfigError, match="cavmarl has this name"):
        cavmarl.register_backend("ray", nothing)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="Numba cannot compile"):
        cavmarl.register_driver_model("wrong", lambda *_: open("x"))  # type: ignore[arg-type,return-value]
