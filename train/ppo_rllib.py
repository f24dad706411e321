"""RLlib's PPO (new API stack) on cavmarl's worlds, with one network shared by all agents.

    python train/ppo_rllib.py --env merge --num-runners 2 --minutes 8

The program uses RLlib's algorithm, env runners and learner on `cavmarl.adapters.rllib_env`, with
cavmarl's network as an `RLModule`. The run's folder has the network as `model.safetensors` and
`config.json`, which `cavmarl evaluate --policy FOLDER` reads, `progress.csv` with the columns of
`ppo.py`, and `manifest.json` with the conditions of the training.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import ray
import torch
from ray.rllib.algorithms.ppo import PPO, PPOConfig
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.core import Columns
from ray.rllib.core.rl_module.apis import ValueFunctionAPI
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from torch import Tensor

from cavmarl.adapters.observations import refuse_signal_agents
from cavmarl.adapters.rllib_env import CavRllibEnv
from cavmarl.env.parallel import parallel_env
from cavmarl.learning.actor_critic import ActorCritic, save_network
from cavmarl.learning.log import WINDOW, curve_row
from cavmarl.learning.loggers import logger_names
from cavmarl.learning.options import (
    LOGGERS,
    check_at_least,
    parse_settings,
    run_folder,
    run_program,
)
from cavmarl.learning.run_folder import RunFolder
from cavmarl.networks.network_files import NetworkConfig
from cavmarl.roads.road_kinds import road_kinds

DRIVER = "driver"  # the policy that all agents share


@dataclass(frozen=True)
class Args:
    """The settings of a run; each is an option of the command line."""

    program: ClassVar[str] = "ppo_rllib.py"

    env: Annotated[str, "environment: a name, a folder or a map file"] = "merge"
    num_runners: Annotated[int, "processes that step worlds; 0: this process"] = 0
    num_worlds: Annotated[int, "worlds per runner"] = 4
    seed: Annotated[int, "root of all random numbers"] = 0
    total_agent_steps: Annotated[int, "decisions to learn from"] = 1_000_000
    minutes: Annotated[float, "stop after this time; 0: no limit"] = 0.0
    num_steps: Annotated[int, "steps per world and update"] = 128
    epochs: Annotated[int, "passes over the decisions of an update"] = 4
    minibatches: Annotated[int, "minibatches per pass"] = 8
    learning_rate: Annotated[float, "learning rate of Adam"] = 5e-4
    gamma: Annotated[float, "discount per step"] = 0.99
    hidden: Annotated[int, "width of the two hidden layers"] = 64
    initial_std: Annotated[float, "initial standard deviation of continuous actions"] = 0.3
    runs: Annotated[str, "folder of all runs"] = "runs"
    name: Annotated[str, "folder of this run; empty: ENV_rllib_SEED"] = ""
    loggers: Annotated[str, LOGGERS] = ""

    def __post_init__(self) -> None:
        least_one = ("num_worlds", "total_agent_steps", "num_steps", "epochs", "minibatches")
        check_at_least(self, {"num_runners": 0, **dict.fromkeys(least_one, 1)})
        logger_names(self.loggers)

    @property
    def folder(self) -> Path:
        """The folder of this run."""
        return run_folder(self.runs, self.name, self.env, "rllib", self.seed)


class Driver(TorchRLModule, ValueFunctionAPI):  # type: ignore[misc] # RLlib is not typed
    """cavmarl's network as an RLlib module."""

    network: ActorCritic

    def setup(self) -> None:
        """Create the network of `model_config`."""
        deviation = self.model_config["initial_std"]
        self.network = ActorCritic(self.model_config["network"], (deviation, deviation))

    def _forward(self, batch: Mapping[str, Tensor], **_: Any) -> dict[str, Tensor]:
        output = self.network(batch[Columns.OBS])
        if self.network.continuous:
            output = torch.cat([output, self.network.log_std.expand_as(output)], dim=-1)
        return {Columns.ACTION_DIST_INPUTS: output}

    def compute_values(self, batch: Mapping[str, Tensor], embeddings: Any = None) -> Tensor:
        """Return expected returns (N,)."""
        return self.network.value(batch[Columns.OBS])


class Trips(RLlibCallback):  # type: ignore[misc] # RLlib is not typed
    """Adds the results of trips to RLlib's metrics; truncated trips do not count."""

    def on_episode_step(self, *, episode: Any, metrics_logger: Any, **_: Any) -> None:
        """Add the reward of each agent, and the trips that have ended."""
        returns = episode.custom_data.setdefault("returns", defaultdict(float))
        infos = episode.get_infos(-1)
        for agent, reward in episode.get_rewards(-1).items():
            returns[agent] += reward
            if infos[agent]["vehicle_done"]:
                metrics_logger.log_value("trips", 1, reduce="lifetime_sum")
                metrics_logger.log_value("trip_return", returns.pop(agent), window=WINDOW)
                arrived = float(infos[agent]["arrival"] > 0.0)
                metrics_logger.log_value("success", arrived, window=WINDOW)


def make_algorithm(args: Args, network: NetworkConfig) -> PPO:
    """Create RLlib's PPO on cavmarl's worlds."""
    runners = max(args.num_runners, 1)
    world_steps = args.num_steps * args.num_worlds * runners
    decisions = world_steps * parallel_env(args.env).config.population.agents
    config = (
        PPOConfig()
        .environment(CavRllibEnv, env_config={"env": args.env})
        .env_runners(
            num_env_runners=args.num_runners,
            num_envs_per_env_runner=args.num_worlds,
            rollout_fragment_length=args.num_steps,
        )
        .multi_agent(policies={DRIVER}, policy_mapping_fn=lambda *_, **__: DRIVER)
        .rl_module(
            rl_module_spec=RLModuleSpec(
                module_class=Driver,
                model_config={"network": network, "initial_std": args.initial_std},
            )
        )
        .training(
            lr=args.learning_rate,
            gamma=args.gamma,
            lambda_=0.95,
            entropy_coeff=0.0,
            use_kl_loss=False,
            clip_param=0.2,
            vf_clip_param=float("inf"),
            grad_clip=0.5,
            grad_clip_by="global_norm",
            train_batch_size_per_learner=world_steps,
            # RLlib counts a minibatch in decisions, but refuses a number above that of world steps.
            minibatch_size=min(max(decisions // args.minibatches, 2), world_steps),
            num_epochs=args.epochs,
        )
        .learners(num_learners=0)
        .callbacks(Trips)
        .debugging(seed=args.seed, log_level="ERROR")
    )
    return config.build_algo()


def train(args: Args) -> Path:
    """Run PPO until the decisions or minutes are used up; return the folder of the run.

    Raises:
        CavmarlError: the settings or the environment are invalid.
    """
    torch.set_num_threads(1)  # faster for small networks
    world = parallel_env(args.env, overrides={"observation.kind": "flat"})
    env = world.config
    refuse_signal_agents(env, "this program")
    network = NetworkConfig(
        environment=env.name,
        observation_size=world.observation_space("car_0").shape[0],  # type: ignore[index]
        sensors=env.sensors,
        action=env.action,
        hidden=(args.hidden, args.hidden),
        seed=args.seed,
        maps=road_kinds(world.network),
    )
    with RunFolder(args, world.simulation) as folder:
        ray.init(num_cpus=args.num_runners + 1, include_dashboard=False, log_to_driver=False)
        algorithm = make_algorithm(args, network)
        updates, decisions = 0, 0
        while decisions < args.total_agent_steps and folder.has_time(args.minutes):
            found = algorithm.train()["env_runners"]
            updates += 1
            decisions = int(found["num_module_steps_sampled_lifetime"][DRIVER])
            means = tuple(found.get(name, float("nan")) for name in ("trip_return", "success"))
            counts = (updates, decisions, folder.seconds, found.get("trips", 0))
            folder.log.write(curve_row(*counts, [means]))
        algorithm.learner_group.foreach_learner(
            lambda learner: save_network(
                args.folder.absolute(),
                learner.module[DRIVER].network,
                replace(network, agent_steps=decisions),
            )
        )
        algorithm.stop()
        ray.shutdown()
        return folder.end()


def main(words: Sequence[str] | None = None) -> int:
    """Train; return 0: trained, 2: an error, 130: interrupted."""
    return run_program(lambda: train(parse_settings(Args, words, __doc__)))


if __name__ == "__main__":
    sys.exit(main())
