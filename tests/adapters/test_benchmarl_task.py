"""Algorithms of BenchMARL run on tasks of cavmarl, in each population mode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.config.registry import entries
from cavmarl.core.errors import ConfigError

benchmarl = pytest.importorskip("benchmarl", reason="needs the extra: benchmarl (make libraries)")

pytestmark = pytest.mark.filterwarnings("ignore")  # TorchRL warns about its own code

MODES = ("closed", "open", "respawn")
SMALL = {"agents": 2, "background": 2, "max_cycles": 8}


def run(
    folder: Path,
    algorithm: str = "Ippo",
    continuous: bool = True,
    task: str = "MERGE",
    agents: int = 2,
    **overrides: Any,
) -> tuple[Any, list[float]]:
    """Run two iterations and an evaluation; return the experiment and its logged mean rewards."""
    import benchmarl.algorithms
    from benchmarl.experiment import Experiment, ExperimentConfig
    from benchmarl.models.mlp import MlpConfig

    from cavmarl.adapters.benchmarl_task import CavTask

    folder.mkdir(exist_ok=True)
    config = ExperimentConfig.get_from_yaml()
    config.sampling_device = config.train_device = config.buffer_device = "cpu"
    config.prefer_continuous_actions = continuous
    config.on_policy_n_envs_per_worker = 2
    config.on_policy_collected_frames_per_batch = config.off_policy_collected_frames_per_batch = 32
    config.on_policy_n_minibatch_iters, config.on_policy_minibatch_size = 1, 16
    config.off_policy_n_optimizer_steps, config.off_policy_train_batch_size = 2, 16
    config.max_n_iters, config.max_n_frames = 2, None
    config.evaluation, config.evaluation_interval, config.evaluation_episodes = True, 32, 2
    config.loggers, config.create_json, config.render = ["csv"], False, False
    config.checkpoint_at_end, config.save_folder = False, str(folder)
    experiment = Experiment(
        task=CavTask[task].get_task({**SMALL, "agents": agents, "overrides": overrides}),
        algorithm_config=getattr(benchmarl.algorithms, f"{algorithm}Config").get_from_yaml(),
        model_config=MlpConfig.get_from_yaml(),
        critic_model_config=MlpConfig.get_from_yaml(),
        seed=0,
        config=config,
    )
    experiment.run()
    (table,) = folder.rglob(
        "collection_reward_reward_mean.csv"
    )  # this table has means over all groups
    rewards = [float(line.split(",")[1]) for line in table.read_text().splitlines()]
    return experiment, rewards


@pytest.mark.parametrize("mode", MODES)
def test_ippo_runs_two_iterations(tmp_path: Path, mode: str) -> None:
    keys = {"population.mode": mode, "population.budget": 4}
    experiment, rewards = run(tmp_path, **keys)
    assert experiment.n_iters_performed == 2
    assert len(rewards) == 2
    assert np.isfinite(rewards).all()
    assert experiment.group_map == {
        "vehicles": [f"car_{k}" for k in range(4 if mode == "open" else 2)]
    }


def test_mappo_runs_with_meta_actions_and_dict_observations(tmp_path: Path) -> None:
    keys = {"observation.kind": "dict"}
    experiment, _ = run(tmp_path, "Mappo", continuous=False, **keys)
    assert experiment.n_iters_performed == 2


SIGNALS = {"signals.agents": "all", "clock.ctrl_dt_s": 5.0, "population.mode": "respawn"}


@pytest.mark.parametrize("algorithm", ["Mappo", "Iql"])
@pytest.mark.parametrize("agents", [0, 2])
def test_vehicles_and_signals_are_groups_that_learn(
    tmp_path: Path, algorithm: str, agents: int
) -> None:
    """With `signals.forbidden: error`, an action that a mask forbids would be an error."""
    keys = SIGNALS | {"signals.forbidden": "error"}
    experiment, rewards = run(tmp_path, algorithm, task="GRID4X4", agents=agents, **keys)
    assert not experiment.continuous_actions
    groups = ["vehicles", "signals"] if agents else ["signals"]
    assert list(experiment.group_map) == groups
    assert len(experiment.group_map["signals"]) == 16
    assert np.isfinite(rewards).all()
    for group in groups:
        optimized = experiment.optimizers[group]
        assert all(optimizer.state for optimizer in optimized.values()), f"{group} does not learn"


def test_the_seed_determines_the_results(tmp_path: Path) -> None:
    assert run(tmp_path / "one")[1] == run(tmp_path / "other")[1]


def test_every_environment_is_a_task() -> None:
    from cavmarl.adapters.benchmarl_task import CavTask

    assert {task.get_task().config["env"] for task in CavTask} == set(entries())
    assert CavTask.RING.get_task().config == {"env": "ring"}


def test_settings_that_benchmarl_decides_are_refused() -> None:
    from cavmarl.adapters.benchmarl_task import CavTaskClass

    with pytest.raises(ConfigError, match=r"^num_envs: this view sets it"):
        CavTaskClass("merge", {"num_envs": 2})
    with pytest.raises(ConfigError, match=r"^action\.kind: this view sets it"):
        CavTaskClass("merge", {"overrides": {"action.kind": "discrete"}})
