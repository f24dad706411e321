"""Worlds as tensors of TorchRL: checks of the library, equality with arrays, training."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cavmarl.config.signals import SIGNAL_TERMS
from cavmarl.config.terms import TERMS
from cavmarl.core.errors import ActionError, ConfigError
from cavmarl.engine.spaces import flat_observation, observation_parts
from cavmarl.env.vector import make_vec
from cavmarl.signals.kernels.green_choices import GREEN

torch = pytest.importorskip("torch", reason="needs the extra: torchrl")

# TorchRL warns about its own code when it is imported.
pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning:torchrl"),
    pytest.mark.filterwarnings("ignore:Creating .* inherits from WeightUpdaterBase"),
]


@pytest.fixture(autouse=True)
def torchrl() -> Any:
    """Return the library. It is imported here, because the import takes seconds."""
    return pytest.importorskip("torchrl", reason="needs the extra: torchrl")


MODES = ("closed", "open", "respawn")
WORLDS, AGENTS, BUDGET, HORIZON = 2, 3, 5, 12
UPDATES, STEPS = 6, 25
VEHICLES = "vehicles"


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
    """Set actions of full throttle and random steering, which soon end most trips."""
    random = torch.Generator().manual_seed(
        int(tensordict[VEHICLES, "observation"].sum() * 1e3) % 2**31
    )
    actions = 2.0 * torch.rand((*tensordict[VEHICLES, "mask"].shape, 2), generator=random) - 1.0
    actions[..., 0] = 1.0
    return tensordict.set((VEHICLES, "action"), actions)


@pytest.mark.parametrize("action", ["continuous", "discrete", "grid"])
@pytest.mark.parametrize("kind", ["flat", "dict"])
@pytest.mark.parametrize("mode", MODES)
def test_the_check_of_torchrl_passes(mode: str, kind: str, action: str) -> None:
    from torchrl.envs.utils import check_env_specs

    env = make(mode, **{"observation.kind": kind, "action.kind": action})
    assert env.batch_size == (WORLDS,)
    assert env.group_map == {VEHICLES: env.vec.possible_agents}
    check_env_specs(env, seed=0, break_when_any_done="both")


@pytest.mark.parametrize("mode", MODES)
def test_tensors_equal_the_arrays_of_the_worlds(mode: str) -> None:
    """TorchRL resets finished worlds between two steps; the arrays reset in the same step."""
    env = make(mode)
    env.set_seed(7)
    rollout = env.rollout(80, wild, break_when_any_done=False)
    vec = make_vec("merge", **settings(mode))
    seen, infos = vec.reset(seed=7)
    after = rollout["next"]
    for step in range(80):
        now, then = rollout[:, step], after[:, step]
        np.testing.assert_array_equal(now[VEHICLES, "observation"], seen)
        np.testing.assert_array_equal(now[VEHICLES, "mask"], infos["mask"])
        seen, rewards, ended, cut, infos = vec.step(now[VEHICLES, "action"].numpy())
        np.testing.assert_array_equal(then[VEHICLES, "observation"], infos["final_observations"])
        np.testing.assert_array_equal(then[VEHICLES, "reward"][..., 0], rewards)
        np.testing.assert_array_equal(then[VEHICLES, "terminated"][..., 0], ended)
        np.testing.assert_array_equal(then[VEHICLES, "truncated"][..., 0], cut)
        np.testing.assert_array_equal(then[VEHICLES, "done"][..., 0], ended | cut)
        np.testing.assert_array_equal(then["done"][:, 0], infos["episode_over"])
        np.testing.assert_array_equal(then["truncated"][:, 0], cut.any(axis=1))
        for k, term in enumerate(TERMS):
            np.testing.assert_array_equal(
                then[VEHICLES, "info", term][..., 0], infos["terms"][..., k]
            )
        if (ended & ~infos["episode_over"][:, None]).any():
            seen = np.where(ended[..., None], infos["final_observations"], seen)
    assert after[VEHICLES, "terminated"].any()
    assert after[VEHICLES, "truncated"].any()
    assert not rollout[VEHICLES, "mask"].all()


def test_a_world_continues_when_single_agents_end() -> None:
    env = make()
    env.set_seed(0)
    rollout = env.rollout(HORIZON, wild, break_when_any_done=True)
    assert rollout.shape == (WORLDS, HORIZON)
    assert rollout["next", VEHICLES, "terminated"].any()
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
    assert not torch.equal(other[VEHICLES, "observation"], first[VEHICLES, "observation"])
    assert not torch.equal(
        env.reset()[VEHICLES, "observation"], other[:, 0][VEHICLES, "observation"]
    )


def test_a_world_can_be_reset_before_it_is_over(torchrl: Any) -> None:
    from torchrl.envs import StepCounter, TransformedEnv

    env = make()
    before = env.step(wild(env.reset()))["next"]
    mask = torch.tensor([[False], [True]])
    again = env.reset(before.clone().set("_reset", mask))
    assert torch.equal(again[0][VEHICLES, "observation"], before[0][VEHICLES, "observation"])
    assert not torch.equal(again[1][VEHICLES, "observation"], before[1][VEHICLES, "observation"])
    if torchrl.__version__.startswith("0.11."):
        pytest.skip("this TorchRL's StepCounter cannot cut agents of a batch")
    counted = TransformedEnv(env, StepCounter(max_steps=5))
    rollout = counted.rollout(12, wild, break_when_any_done=False)
    assert rollout["next", "done"].squeeze(-1).sum(-1).tolist() == [2, 2]
    assert rollout["step_count"].max() == 4


def test_later_steps_do_not_change_earlier_tensors() -> None:
    env = make()
    state = env.reset()
    kept = [state.clone(), state]
    for _ in range(3):
        state = env.step_mdp(env.step(wild(state)))
    assert (kept[0] == kept[1].select(*kept[0].keys(True, True))).all()


def test_observations_can_be_named_by_sensor() -> None:
    named, flat = make(**{"observation.kind": "dict"}), make()
    for env in (named, flat):
        env.set_seed(1)
    parts = observation_parts(named.vec.config.sensors)
    shown, wanted = named.reset()[VEHICLES, "observation"], flat.reset()[VEHICLES, "observation"]
    assert list(shown.keys()) == list(parts)
    one = {name: part[1, 2].numpy() for name, part in shown.items()}
    np.testing.assert_array_equal(flat_observation(parts, one, stack=1), wanted[1, 2])


def test_the_collector_of_torchrl_returns_whole_batches() -> None:
    from torchrl.collectors import Collector

    collector = Collector(make, wild, frames_per_batch=20, total_frames=40)
    batches = list(collector)
    collector.shutdown()
    assert [batch.numel() for batch in batches] == [20, 20]
    assert batches[1]["next", VEHICLES, "reward"].shape == (WORLDS, 10, AGENTS, 1)


def test_wrong_use_is_refused() -> None:
    from cavmarl.adapters.torchrl_env import CavTorchRLEnv

    for key, value in {"autoreset_mode": "SameStep", "copy": False}.items():
        with pytest.raises(ConfigError, match=f"^{key}: this view sets it"):
            CavTorchRLEnv("merge", **{key: value})
    with pytest.raises(ConfigError, match="seed"):
        make().set_seed(-1)
    env = make()
    beyond = env.reset().set((VEHICLES, "action"), torch.full((WORLDS, AGENTS, 2), 3.0))
    with pytest.raises(ActionError, match="must be within"):
        env.step(beyond)


# Agents of signals

TOWN = {"signals.agents": "all", "clock.ctrl_dt_s": 1.0, "signals.decide_s": 2.0, "horizon_s": 9.0}


def town(agents: int = 2, **overrides: Any) -> Any:
    """Return worlds whose signals differ in their numbers of lanes and greens."""
    from cavmarl.adapters.torchrl_env import CavTorchRLEnv

    keys = TOWN | overrides
    return CavTorchRLEnv("town", num_envs=WORLDS, agents=agents, background=20, overrides=keys)


@pytest.mark.parametrize("action", ["continuous", "discrete"])
def test_vehicles_and_signals_are_groups(action: str) -> None:
    from torchrl.envs.utils import check_env_specs

    env = town(**{"action.kind": action, "observation.kind": "dict"})
    signals = env.vec.signals
    assert env.group_map == {
        "vehicles": env.vec.possible_agents,
        "signals": list(signals.agents),
    }
    check_env_specs(env, seed=0, break_when_any_done="both")
    assert len(set(signals.num_choices.tolist())) > 1
    assert len(set(signals.table.features)) > 1
    first = env.reset()
    assert ("action_mask" in first["vehicles"].keys()) == (action == "discrete")
    if action == "discrete":
        assert first["vehicles", "action_mask"].all()
    assert first["signals", "action_mask"].any(-1).all()


@pytest.mark.parametrize("mode", MODES)
def test_tensors_of_signals_equal_the_arrays_of_the_worlds(mode: str) -> None:
    """A signal keeps its green if the chosen green does not exist at this signal."""
    keys = {"population.mode": mode, "population.budget": 4}
    env = town(**keys)
    vec = make_vec("town", num_envs=WORLDS, agents=2, background=20, overrides=TOWN | keys)
    random = torch.Generator().manual_seed(0)
    most = env.action_spec["signals", "action"].n
    beyond = 0

    def policy(tensordict: Any) -> Any:
        shape = tensordict["signals", "mask"].shape
        tensordict["signals", "action"] = torch.randint(most, shape, generator=random)
        cars = 2.0 * torch.rand((*tensordict["vehicles", "mask"].shape, 2), generator=random) - 1.0
        return tensordict.set(("vehicles", "action"), cars)

    env.set_seed(7)
    rollout = env.rollout(30, policy, break_when_any_done=False)
    after = rollout["next"]
    seen, infos = vec.reset(seed=7)
    for step in range(30):
        now, then = rollout[:, step], after[:, step]
        np.testing.assert_array_equal(now["signals", "observation"], seen["signals"])
        np.testing.assert_array_equal(now["signals", "action_mask"], infos["signal_mask"])
        decides = infos["signal_decides"]
        np.testing.assert_array_equal(now["signals", "mask"], decides[:, None].repeat(9, 1))
        choices = now["signals", "action"].numpy()
        greens = vec.signals.view.states[..., GREEN]
        own = np.where(choices < vec.signals.num_choices, choices, greens)
        beyond += int((own != choices).sum())
        actions = {"vehicles": now["vehicles", "action"].numpy(), "signals": own}
        seen, rewards, ended, cut, infos = vec.step(actions)
        last = infos["final_observations"]
        for group in ("vehicles", "signals"):
            np.testing.assert_array_equal(then[group, "observation"], last[group])
            np.testing.assert_array_equal(then[group, "reward"][..., 0], rewards[group])
            np.testing.assert_array_equal(then[group, "terminated"][..., 0], ended[group])
            np.testing.assert_array_equal(then[group, "truncated"][..., 0], cut[group])
        np.testing.assert_array_equal(then["done"][:, 0], infos["episode_over"])
        np.testing.assert_array_equal(then["truncated"][:, 0], infos["episode_over"])
        for k, term in enumerate(SIGNAL_TERMS):
            found = then["signals", "info", term][..., 0]
            np.testing.assert_array_equal(found, infos["signal_terms"][..., k])
        left = ended["vehicles"] & ~infos["episode_over"][:, None]
        if left.any():
            seen["vehicles"] = np.where(left[..., None], last["vehicles"], seen["vehicles"])
    assert beyond > 0
    assert after["signals", "reward"].any()
    assert int(after["done"].sum()) == 6
    assert env.vec.state_hash() == vec.state_hash()


def test_the_action_mask_of_torchrl_leaves_only_allowed_greens() -> None:
    from torchrl.envs import ActionMask, TransformedEnv

    env = town(agents=0, **{"signals.forbidden": "error", "signals.max_green_s": 10.0})
    assert list(env.group_map) == ["signals"]
    masked = TransformedEnv(env, ActionMask(("signals", "action"), ("signals", "action_mask")))
    rollout = masked.rollout(40, break_when_any_done=False)
    assert len(rollout["signals", "action"].unique()) > 4
    with pytest.raises(ActionError, match="is not allowed now"):
        env.rollout(40, break_when_any_done=False)


@pytest.mark.filterwarnings(
    "ignore:size_average and reduce args"
)  # a warning about code of TorchRL 0.11
def test_ppo_learns_to_give_green_to_the_longest_queues() -> None:
    """All signals share one network; distribution, advantages and loss come from TorchRL."""
    from tensordict import TensorDict
    from tensordict.nn import TensorDictModule
    from torchrl.envs import ExplorationType, set_exploration_type
    from torchrl.modules import MLP, MaskedCategorical, ProbabilisticActor
    from torchrl.objectives import ClipPPOLoss
    from torchrl.objectives.value import GAE

    from cavmarl.adapters.torchrl_env import CavTorchRLEnv

    torch.manual_seed(0)
    keys = {
        "signals.agents": "all", "signals.terms": {"queue": 0.1}, "signals.max_green_s": 0.0,
        "clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 5.0, "horizon_s": 5.0 * STEPS,
        "population.mode": "open",
    }  # fmt: skip
    env = CavTorchRLEnv("grid4x4", num_envs=2, agents=0, background=150, overrides=keys)
    seen, mask, action = (("signals", name) for name in ("observation", "action_mask", "action"))
    size, choices = env.observation_spec[seen].shape[-1], int(env.action_spec[action].n)
    logits, value = ("signals", "logits"), ("signals", "state_value")
    actor = ProbabilisticActor(
        TensorDictModule(MLP(size, choices, num_cells=[32]), [seen], [logits]),
        in_keys={"logits": logits, "mask": mask},
        out_keys=[action],
        distribution_class=MaskedCategorical,
        return_log_prob=True,
        log_prob_key=("signals", "log_prob"),
    )
    critic = TensorDictModule(MLP(size, 1, num_cells=[32]), [seen], [value])
    ends = {name: ("signals", name) for name in ("reward", "done", "terminated")}
    advantages = GAE(gamma=0.9, lmbda=0.9, value_network=critic)
    loss = ClipPPOLoss(actor, critic, normalize_advantage=True, entropy_coeff=0.01)
    advantages.set_keys(value=value, **ends)
    loss.set_keys(value=value, action=action, sample_log_prob=("signals", "log_prob"), **ends)
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-3)
    returns = []
    for _ in range(UPDATES):
        env.set_seed(0)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            batch = env.rollout(STEPS, actor, break_when_any_done=False)
            returns.append(float(batch["next", "signals", "reward"].mean()))
            rows = TensorDict(
                {"signals": batch["signals"], "next": {"signals": batch["next", "signals"]}},
                batch["signals"].shape,
            )
            rows = rows.transpose(1, 2).reshape(-1, STEPS)
            advantages(rows)
        for _ in range(4):
            losses = loss(rows.reshape(-1))
            optimizer.zero_grad()
            (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
            optimizer.step()
    assert np.mean(returns[-2:]) > 0.9 * np.mean(returns[:2])
