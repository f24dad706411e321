"""BenchMARL's algorithms on cavmarl's worlds: IPPO, MAPPO and others.

    python train/ippo_benchmarl.py --env merge --updates 300
    python train/ippo_benchmarl.py --env town --algorithm mappo

The program uses BenchMARL's algorithm, model and experiment on `cavmarl.adapters.benchmarl_task`.
The run's folder has its tables (`ippo_merge_mlp…/…/scalars/*.csv`), the policy's weights as
`policy.pt`, and `manifest.json` with the conditions of the training. With IPPO and continuous
actions, it also has the same network as `model.safetensors` and `config.json`, which `cavmarl
evaluate --policy FOLDER` reads. Other programs of cavmarl cannot read networks of the other
algorithms.
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
from cavmarl.config.driver_form import CONFIG_FILE, WEIGHTS_FILE
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.learning.actor_critic import ActorCritic, save_network
from cavmarl.learning.checkpoint import writing
from cavmarl.learning.options import (
    check_at_least,
    parse_settings,
    run_folder,
    run_program,
)
from cavmarl.learning.run_folder import RunFolder
from cavmarl.networks.network_files import NetworkConfig
from cavmarl.roads.road_kinds import road_kinds

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
    algorithm = algorithm_config_registry[args.algorithm].get_from_yaml()
    if hasattr(algorithm, "use_tanh_normal"):  # drivers clip means instead
        algorithm.use_tanh_normal = False
    return Experiment(
        task=CavTaskClass(stem, {"env": args.env, "overrides": {"action.out_of_range": "clip"}}),
        algorithm_config=algorithm,
        model_config=model,
        critic_model_config=model,
        seed=args.seed,
        config=config,
    )


def save_driver(experiment: Experiment, args: Args) -> tuple[str, ...]:
    """Write the network in the form of cavmarl's drivers; return the names of its files.

    Only networks of IPPO with continuous actions have this form; for other networks, nothing is
    written.
    """
    env = load_config(args.env)[0]
    if args.algorithm != "ippo" or env.action.kind != "continuous":
        return ()
    vec = experiment.test_env.base_env.vec
    config = NetworkConfig(
        environment=env.name,
        observation_size=vec.single_observation_space.shape[-1],
        sensors=env.sensors,
        action=env.action,
        hidden=(args.hidden, args.hidden),
        seed=args.seed,
        agent_steps=experiment.total_frames,
        maps=road_kinds(vec.network),
    )
    network = ActorCritic(config)
    (loss,) = experiment.losses.values()
    found = {name: tensor.detach() for name, tensor in loss.named_parameters()}
    weights = dict(network.state_dict())
    for head in ("actor", "critic"):
        (start,) = {
            name[: name.index("mlp.params.")] for name in found if name.startswith(f"{head}_")
        }
        for name in weights:
            if name.startswith(f"{head}."):
                # BenchMARL's last layer also has outputs for the standard deviations.
                tensor = found[f"{start}mlp.params.{name.removeprefix(f'{head}.')}"]
                weights[name] = tensor[: len(weights[name])].clone()
    network.load_state_dict(weights)
    save_network(args.folder, network, config)
    return WEIGHTS_FILE, CONFIG_FILE


def train(args: Args) -> Path:
    """Run the experiment to its last update; return its folder.

    Raises:
        CavmarlError: the settings or the environment are invalid.
    """
    torch.set_num_threads(1)  # faster for small networks
    args.folder.mkdir(parents=True, exist_ok=True)
    experiment = make_experiment(args)
    with RunFolder(args, experiment.test_env.base_env.vec.worlds.world) as folder:
        experiment.run()
        with writing(args.folder / POLICY_FILE):
            torch.save(experiment.policy.state_dict(), args.folder / POLICY_FILE)
        return folder.end((POLICY_FILE, *save_driver(experiment, args)))


def main(words: Sequence[str] | None = None) -> int:
    """Train; return 0: trained, 2: an error, 130: interrupted."""
    return run_program(lambda: train(parse_settings(Args, words, __doc__)), "run: {folder}")


if __name__ == "__main__":
    sys.exit(main())
