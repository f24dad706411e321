"""Worlds as tensors of TorchRL: its own checks, and equality with the arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cavmarl.config.terms import TERMS
from cavmarl.core.errors import ActionError, ConfigError
from cavmarl.engine.spaces import flat_observation, observation_parts
from cavmarl.env.vector import make_vec

torch = pytest.importorskip("torch", reason="needs the extra: torchrl")
torchrl = pytest.importorskip("torchrl", reason="needs the extra: torchrl")

# TorchRL warns about its own code when it is imported.
pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning:torchrl"),
    pytest.mark.filterwarnings("ignore:Creating .* inherits from WeightUpdaterBase"),
]

MODES = ("closed", "open", "respawn")
WORLDS, AGENTS, BUDGET, HORIZON = 2, 3, 5, 12
CAR = "car"


def settings(mode: str = "respawn", **overrides: Any) -> dict[str, Any]:
    keys = {"population.mode": mode, "population.budget": BUDGET, **overrides}
    return {
        "num_envs": WORLDS, "agents": AGENTS, "background": 3, "max_cycles": HORIZON,
        "overrides": keys,
    }  # fmt: skip


def make(mode: str = "respawn", **overrides: Any) -> Any:
    from cavmarl.adapters.torchrl_env import CavTorchRLEnv

    return CavTorchRLEnv("merge", **settings(mode, **overrides))


def wild(tensordict: Any) -> Any:
    """Return a policy of full throttle: vehicles leave the road, or their trips are truncated."""
    random = torch.Generator().manual_seed(int(tensordict[CAR, "observation"].sum() * 1e3) % 2**31)
    actions = 2.0 * torch.rand((*tensordict[CAR, "mask"].shape, 2), generator=random) - 1.0
    actions[..., 0] = 1.0
    return tensordict.set((CAR, "action"), actions)


@pytest.mark.parametrize("action", ["continuous", "discrete", "grid"])
@pytest.mark.parametrize("kind", ["flat", "dict"])
@pytest.mark.parametrize("mode", MODES)
def test_torchrls_own_check_passes(mode: str, kind: str, action: str) -> None:
    from torchrl.envs.utils import check_env_specs

    env = make(mode, **{"observation.kind": kind, "action.kind": action})
    assert env.batch_size == (WORLDS,)
    assert env.group_map == {CAR: env.vec.possible_agents}
    check_env_specs(env, seed=0, break_when_any_done="both")


@pytest.mark.parametrize("mode", MODES)
def test_the_tensors_are_the_worlds_arrays(mode: str) -> None:
    """TorchRL resets a world between two steps; the arrays reset themselves."""
    env = make(mode)
    env.set_seed(7)
    rollout = env.rollout(80, wild, break_when_any_done=False)
    vec = make_vec("merge", **settings(mode))
    seen, infos = vec.reset(seed=7)
    after = rollout["next"]
    for step in range(80):
        now, then = rollout[:, step], after[:, step]
        np.testing.assert_array_equal(now[CAR, "observation"], seen)
        np.testing.assert_array_equal(now[CAR, "mask"], infos["mask"])
        seen, rewards, ended, cut, infos = vec.step(now[CAR, "action"].numpy())
        np.testing.assert_array_equal(then[CAR, "observation"], infos["final_observations"])
        np.testing.assert_array_equal(then[CAR, "reward"][..., 0], rewards)
        np.testing.assert_array_equal(then[CAR, "terminated"][..., 0], ended)
        np.testing.assert_array_equal(then[CAR, "truncated"][..., 0], cut)
        np.testing.assert_array_equal(then[CAR, "done"][..., 0], ended | cut)
        np.testing.assert_array_equal(then["done"][:, 0], infos["episode_over"])
        np.testing.assert_array_equal(then["truncated"][:, 0], cut.any(axis=1))
        for k, term in enumerate(TERMS):
            np.testing.assert_array_equal(then[CAR, "info", term][..., 0], infos["terms"][..., k])
        if (ended & ~infos["episode_over"][:, None]).any():
            seen = np.where(ended[..., None], infos["final_observations"], seen)
    assert after[CAR, "terminated"].any()
    assert after[CAR, "truncated"].any()
    assert not rollout[CAR, "mask"].all()


def test_agents_end_singly_and_their_world_goes_on() -> None:
    env = make()
    env.set_seed(0)
    rollout = env.rollout(HORIZON, wild, break_when_any_done=True)
    assert rollout.shape == (WORLDS, HORIZON)
    assert rollout["next", CAR, "terminated"].any()
    assert not rollout["next", "done"][:, :-1].any()
    assert rollout["next", "truncated"][:, -1].all()


def test_the_seed_determines_the_results() -> None:
    def episode(env: Any, seed: int) -> Any:
        env.set_seed(seed)
        return env.rollout(20, wild, break_when_any_done=False)

    env = make()
    first = episode(env, 3)
    assert (episode(env, 3) == first).all()
    assert (episode(make(), 3) == first).all()
    other = episode(env, 4)
    assert not torch.equal(other[CAR, "observation"], first[CAR, "observation"])
    assert not torch.equal(env.reset()[CAR, "observation"], other[:, 0][CAR, "observation"])


def test_a_world_can_be_reset_before_it_is_over() -> None:
    from torchrl.envs import StepCounter, TransformedEnv

    env = make()
    before = env.step(wild(env.reset()))["next"]
    mask = torch.tensor([[False], [True]])
    again = env.reset(before.clone().set("_reset", mask))
    assert torch.equal(again[0][CAR, "observation"], before[0][CAR, "observation"])
    assert not torch.equal(again[1][CAR, "observation"], before[1][CAR, "observation"])
    if torchrl.__version__.startswith("0.11."):
        pytest.skip("this TorchRL's StepCounter cannot cut agents of a batch")
    counted = TransformedEnv(env, StepCounter(max_steps=5))
    rollout = counted.rollout(12, wild, break_when_any_done=False)
    assert rollout["next", "done"].squeeze(-1).sum(-1).tolist() == [2, 2]
    assert rollout["step_count"].max() == 4


def test_kept_tensors_are_not_overwritten() -> None:
    env = make()
    state = env.reset()
    kept = [state.clone(), state]
    for _ in range(3):
        state = env.step_mdp(env.step(wild(state)))
    assert (kept[0] == kept[1].select(*kept[0].keys(True, True))).all()


def test_observations_may_be_named_by_sensor() -> None:
    named, flat = make(**{"observation.kind": "dict"}), make()
    for env in (named, flat):
        env.set_seed(1)
    parts = observation_parts(named.vec.config.sensors)
    shown, wanted = named.reset()[CAR, "observation"], flat.reset()[CAR, "observation"]
    assert list(shown.keys()) == list(parts)
    one = {name: part[1, 2].numpy() for name, part in shown.items()}
    np.testing.assert_array_equal(flat_observation(parts, one, stack=1), wanted[1, 2])


def test_torchrls_collector_gathers_whole_batches() -> None:
    from torchrl.collectors import Collector

    collector = Collector(make, wild, frames_per_batch=20, total_frames=40)
    batches = list(collector)
    collector.shutdown()
    assert [batch.numel() for batch in batches] == [20, 20]
    assert batches[1]["next", CAR, "reward"].shape == (WORLDS, 10, AGENTS, 1)


def test_wrong_use_is_refused() -> None:
    from cavmarl.adapters.torchrl_env import CavTorchRLEnv

    for key, value in {"autoreset_mode": "SameStep", "copy": False}.items():
        with pytest.raises(ConfigError, match=f"^{key}: this view sets it"):
            CavTorchRLEnv("merge", **{key: value})
    with pytest.raises(ConfigError, match="seed"):
        make().set_seed(-1)
    env = make()
    beyond = env.reset().set((CAR, "action"), torch.full((WORLDS, AGENTS, 2), 3.0))
    with pytest.raises(ActionError, match="must be within"):
        env.step(beyond)
