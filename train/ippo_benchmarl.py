"""BenchMARL's algorithms on cavmarl's worlds: IPPO, MAPPO and others.

    python train/ippo_benchmarl.py --env merge --updates 300
    python train/ippo_benchmarl.py --env town --algorithm mappo

The program uses BenchMARL's algorithm, model and experiment on `cavmarl.adapters.benchmarl_task`.
The run's folder has its tables (`ippo_merge_mlp…/…/scalars/*.csv`), the policy's weights as
`policy.pt`, and `manifest.json` with the conditions of the training. Other programs of cavmarl
cannot read BenchMARL's networks.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import torch
from benchmarl.algorithms import algorithm_config_registry
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig

from cavmarl.adapters.benchmarl_task import CavTaskClass
from cavmarl.core.errors import ConfigError
from cavmarl.learning.checkpoint import writing
from cavmarl.learning.options import (
    check_at_least,
    parse_settings,
    run_folder,
    run_program,
)
from cavmarl.learning.run_folder import RunFolder

POLICY_FILE = "policy.pt"


@dataclass(frozen=True)
class Args:
    """The settings of a run; each is an option of the command line."""

    program: ClassVar[str] = "ippo_benchmarl.py"

    env: Annotated[str, "environment: a name, a folder or a map file"] = "merge"
    algorithm: Annotated[str, "algorithm, by BenchMARL's name"] = "ippo"
    num_worlds: Annotated[int, "number of parallel worlds"] = 32
    seed: Annotated[int, "root of all random numbers"] = 0
    updates: Annotated[int, "number of updates"] = 100
    num_steps: Annotated[int, "steps per world and update"] = 128
    epochs: Annotated[int, "passes over the steps of an update"] = 4
    minibatches: Annotated[int, "minibatches per pass"] = 8
    learning_rate: Annotated[float, "learning rate of Adam"] = 1e-3
    gamma: Annotated[float, "discount per step"] = 0.99
    hidden: Annotated[int, "width of the two hidden layers"] = 64
    runs: Annotated[str, "folder of all runs"] = "runs"
    name: Annotated[str, "folder of this run; empty: ENV_benchmarl_SEED"] = ""

    def __post_init__(self) -> None:
        least_one = ("num_worlds", "updates", "num_steps", "epochs", "minibatches")
        check_at_least(self, dict.fromkeys(least_one, 1))
        if self.algorithm not in algorithm_config_registry:
            known = ", ".join(algorithm_config_registry)
            raise ConfigError(f"--algorithm {self.algorithm}: must be one of {known}")

    @property
    def folder(self) -> Path:
        """The folder of this run."""
        return run_folder(self.runs, self.name, self.env, "benchmarl", self.seed)


def make_experiment(args: Args) -> Experiment:
    """Create BenchMARL's experiment on cavmarl's worlds."""
    config = ExperimentConfig.get_from_yaml()
    config.sampling_device = config.train_device = config.buffer_device = "cpu"
    config.gamma, config.lr = args.gamma, args.learning_rate
    config.max_n_iters, config.max_n_frames = args.updates, None
    frames = args.num_worlds * args.num_steps
    for policy in ("on_policy", "off_policy"):
        setattr(config, f"{policy}_n_envs_per_worker", args.num_worlds)
        setattr(config, f"{policy}_collected_frames_per_batch", frames)
    config.on_policy_n_minibatch_iters = args.epochs
    config.on_policy_minibatch_size = max(frames // args.minibatches, 1)
    config.evaluation = config.render = config.create_json = config.checkpoint_at_end = False
    config.loggers, config.save_folder = ["csv"], str(args.folder)
    model = MlpConfig(
        num_cells=[args.hidden, args.hidden],
        layer_class=torch.nn.Linear,
        activation_class=torch.nn.Tanh,
    )
    stem = Path(args.env).name.split(".")[0]
    return Experiment(
        task=CavTaskClass(stem, {"env": args.env}),
        algorithm_config=algorithm_config_registry[args.algorithm].get_from_yaml(),
        model_config=model,
        critic_model_config=model,
        seed=args.seed,
        config=config,
    )


def train(args: Args) -> Path:
    """Run the experiment to its last update; return its folder.

    Raises:
        CavmarlError: the settings or the environment are invalid.
    """
    torch.set_num_threads(1)  # more threads slow small networks down
    args.folder.mkdir(parents=True, exist_ok=True)
    experiment = make_experiment(args)
    with RunFolder(args, experiment.test_env.base_env.vec.worlds.world) as folder:
        experiment.run()
        with writing(args.folder / POLICY_FILE):
            torch.save(experiment.policy.state_dict(), args.folder / POLICY_FILE)
        return folder.end((POLICY_FILE,))


def main(words: Sequence[str] | None = None) -> int:
    """Train; return 0: trained, 2: wrong usage."""
    return run_program(lambda: train(parse_settings(Args, words, __doc__)), "run: {folder}")


if __name__ == "__main__":
    sys.exit(main())
