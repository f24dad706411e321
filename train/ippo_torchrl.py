"""TorchRL's PPO on cavmarl's worlds, with one network shared by all agents (IPPO).

    python train/ippo_torchrl.py --env merge --minutes 8

The program uses TorchRL's collector, advantages and clipped loss on `cavmarl.adapters.torchrl_env`,
with cavmarl's network. The run's folder has the network as `model.safetensors` and `config.json`,
which `cavmarl evaluate --policy FOLDER` reads, `progress.csv` with the columns of `ppo.py`,
`manifest.json` with the conditions of the training, and `checkpoint.pt`. `--resume FOLDER`
continues from the checkpoint in new episodes, because TorchRL's collector does not expose the state
of its worlds.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from cavmarl.adapters.observations import refuse_signal_agents
from cavmarl.adapters.torchrl_env import CavTorchRLEnv
from cavmarl.config.registry import load_config
from cavmarl.env.roadside_agents import VEHICLES
from cavmarl.learning.actor_critic import ActorCritic
from cavmarl.learning.checkpoint import Parts
from cavmarl.learning.log import WINDOW, curve_row
from cavmarl.learning.loggers import logger_names
from cavmarl.learning.options import LOGGERS, RESUME, check_at_least, run_folder, run_program
from cavmarl.learning.run_folder import RunFolder, parse_run
from cavmarl.networks.network_files import NetworkConfig

LEAST_DEVIATION = 0.02  # smallest scale of an observation, for constants
OBSERVATION, MASK, ACTION, LOG_PROB, VALUE = (
    (VEHICLES, name) for name in ("observation", "mask", "action", "log_prob", "state_value")
)


@dataclass(frozen=True)
class Args:
    """The settings of a run; each is an option of the command line."""

    program: ClassVar[str] = "ippo_torchrl.py"

    env: Annotated[str, "environment: a name, a folder or a map file"] = "merge"
    num_worlds: Annotated[int, "number of parallel worlds"] = 32
    seed: Annotated[int, "root of all random numbers"] = 0
    total_agent_steps: Annotated[int, "decisions to learn from"] = 4_000_000
    minutes: Annotated[float, "stop after this time; 0: no limit"] = 0.0
    num_steps: Annotated[int, "steps per world and update"] = 128
    epochs: Annotated[int, "passes over the decisions of an update"] = 4
    minibatches: Annotated[int, "minibatches per pass"] = 8
    learning_rate: Annotated[float, "learning rate of Adam, annealed to 0"] = 1e-3
    gamma: Annotated[float, "discount per step"] = 0.99
    gae_lambda: Annotated[float, "lambda of generalised advantage estimation"] = 0.95
    hidden: Annotated[int, "width of the two hidden layers"] = 64
    initial_std: Annotated[float, "initial standard deviation of continuous actions"] = 0.3
    runs: Annotated[str, "folder of all runs"] = "runs"
    name: Annotated[str, "folder of this run; empty: ENV_torchrl_SEED"] = ""
    checkpoint_updates: Annotated[int, "updates between two checkpoints"] = 20
    resume: Annotated[str, RESUME] = ""
    loggers: Annotated[str, LOGGERS] = ""

    def __post_init__(self) -> None:
        least_one = ("num_worlds", "total_agent_steps", "num_steps", "epochs", "minibatches")
        check_at_least(self, dict.fromkeys((*least_one, "checkpoint_updates"), 1))
        logger_names(self.loggers)

    @property
    def folder(self) -> Path:
        """The folder of this run."""
        name = (self.name, self.env, "torchrl", self.seed)
        return run_folder(self.runs, *name, resume=self.resume)


class Policy(nn.Module):
    """A network's policy in the form of TorchRL's distributions: means and deviations, or logits.

    Args:
        network: the network.
    """

    def __init__(self, network: ActorCritic) -> None:
        super().__init__()
        self.network = network

    def forward(self, observations: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Compute the parameters for observations (…, D)."""
        output: Tensor = self.network(observations)
        if not self.network.continuous:
            return output
        return output, self.network.log_std.exp().expand_as(output)


class Value(nn.Module):
    """A network's value function, with TorchRL's last axis of size 1.

    Args:
        network: the network.
    """

    def __init__(self, network: ActorCritic) -> None:
        super().__init__()
        self.network = network

    def forward(self, observations: Tensor) -> Tensor:
        """Compute the values of observations (…, D)."""
        return self.network.value(observations).unsqueeze(-1)


def make_actor(network: ActorCritic) -> ProbabilisticActor:
    """Create the policy that all agents of a batch of worlds share."""
    names = ("loc", "scale") if network.continuous else ("logits",)
    numbers = {name: (VEHICLES, name) for name in names}
    return ProbabilisticActor(
        TensorDictModule(Policy(network), in_keys=[OBSERVATION], out_keys=list(numbers.values())),
        in_keys=numbers,
        out_keys=[ACTION],
        distribution_class=(
            IndependentNormal if network.continuous else torch.distributions.Categorical
        ),
        return_log_prob=True,
        log_prob_key=LOG_PROB,
    )


def rows_of(batch: TensorDict) -> TensorDict:
    """Convert the (W, T) steps of worlds to (W · A, T) steps of agents."""
    agents = batch[MASK].shape
    steps = TensorDict(
        {VEHICLES: batch[VEHICLES], "next": {VEHICLES: batch["next", VEHICLES]}}, agents
    )
    return steps.transpose(1, 2).reshape(-1, agents[1])


class Learner:
    """Trains the network with batches of steps.

    Args:
        network: network shared by all agents.
        args: settings of the run.
    """

    def __init__(self, network: ActorCritic, args: Args) -> None:
        self._args = args
        critic = TensorDictModule(Value(network), in_keys=[OBSERVATION], out_keys=[VALUE])
        self.actor = make_actor(network)
        self._advantages = GAE(gamma=args.gamma, lmbda=args.gae_lambda, value_network=critic)
        self._loss = ClipPPOLoss(self.actor, critic, normalize_advantage=True, entropy_coeff=0.0)
        ends = {name: (VEHICLES, name) for name in ("reward", "done", "terminated")}
        self._advantages.set_keys(value=VALUE, **ends)
        self._loss.set_keys(value=VALUE, action=ACTION, sample_log_prob=LOG_PROB, **ends)
        self._network = network
        self._optimizer = torch.optim.Adam(network.parameters(), eps=1e-5)

    def save(self) -> Parts:
        """Return the states of the network and its optimiser."""
        return {"network": self._network.state_dict(), "optimizer": self._optimizer.state_dict()}

    def load(self, saved: Parts) -> None:
        """Restore the state returned by `save`."""
        self._network.load_state_dict(saved["network"])
        self._optimizer.load_state_dict(saved["optimizer"])

    def update(self, batch: TensorDict, left: float) -> int:
        """Learn from (W, T) steps; return the number of decisions.

        Args:
            batch: the steps.
            left: remaining share of the run.
        """
        rows = rows_of(batch)
        with torch.no_grad():
            self._advantages(rows)
        decisions = rows[rows[MASK]]
        for group in self._optimizer.param_groups:
            group["lr"] = self._args.learning_rate * left
        for _ in range(self._args.epochs):
            for chosen in torch.randperm(len(decisions)).chunk(self._args.minibatches):
                self._learn(decisions[chosen])
        return len(decisions)

    def _learn(self, decisions: TensorDict) -> None:
        losses = self._loss(decisions)
        self._optimizer.zero_grad()
        (losses["loss_objective"] + losses["loss_critic"]).backward()
        parameters = self._optimizer.param_groups[0]["params"]
        torch.nn.utils.clip_grad_norm_(parameters, max_norm=0.5)
        self._optimizer.step()


class Curve:
    """Writes a line per update. Trips that the horizon truncates do not count.

    Args:
        folder: folder of the run.
    """

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder
        self._ended: deque[tuple[float, bool]] = deque(maxlen=WINDOW)
        self._returns: Any = 0.0
        self._trips = 0
        self.updates = folder.began.updates

    def save(self) -> Parts:
        """Return the last trips; unfinished trips are not saved."""
        return {"ended": list(self._ended), "trips": self._trips}

    def load(self, saved: Parts) -> None:
        """Restore the state returned by `save`."""
        self._ended.extend(saved["ended"])
        self._trips = saved["trips"]

    def write(self, batch: TensorDict, decisions: int) -> None:
        """Add an update's line, with the trips that ended in its (W, T) steps."""
        after = batch["next", VEHICLES]
        arrived = after["info", "arrival"] > 0.0
        for step in range(batch.shape[1]):
            self._returns = self._returns + after["reward"][:, step]
            ended = after["terminated"][:, step]
            trips = zip(
                self._returns[ended].tolist(), arrived[:, step][ended].tolist(), strict=True
            )
            self._ended.extend(trips)
            self._trips += int(ended.sum())
            self._returns[after["done"][:, step]] = 0.0
        self.updates += 1
        counts = (self.updates, decisions, self._folder.seconds, self._trips)
        self._folder.log.write(curve_row(*counts, self._ended))


def make_worlds(args: Args) -> CavTorchRLEnv:
    """Create the training worlds, which clip normally distributed actions to ±1."""
    worlds = CavTorchRLEnv(
        args.env,
        num_envs=args.num_worlds,
        overrides={
            "population.mode": "respawn",
            "observation.kind": "flat",
            "action.out_of_range": "clip",
        },
    )
    refuse_signal_agents(worlds.vec.config, "this program")
    worlds.set_seed(args.seed)
    return worlds


def make_network(args: Args, worlds: CavTorchRLEnv) -> tuple[ActorCritic, NetworkConfig]:
    """Create a network that scales observations by statistics of its own first steps."""
    env = load_config(args.env)[0]
    config = NetworkConfig(
        environment=env.name,
        observation_size=worlds.observation_spec[OBSERVATION].shape[-1],
        sensors=env.sensors,
        action=env.action,
        hidden=(args.hidden, args.hidden),
        seed=args.seed,
    )
    network = ActorCritic(config, initial_std=(args.initial_std, args.initial_std))
    with torch.no_grad():
        first = worlds.rollout(args.num_steps, make_actor(network), break_when_any_done=False)
    seen = first[OBSERVATION][first[MASK]]
    network.mean.copy_(seen.mean(dim=0))
    network.deviation.copy_(seen.std(dim=0).clamp(min=LEAST_DEVIATION))
    return network, config


def train(args: Args) -> Path:
    """Run PPO until the decisions or minutes are used up; return the folder of the run.

    Raises:
        CavmarlError: the settings or the environment are invalid.
    """
    torch.set_num_threads(1)  # faster for small networks
    torch.manual_seed(args.seed)
    worlds = make_worlds(args)
    network, config = make_network(args, worlds)
    stepped = worlds.vec.worlds
    with RunFolder(args, stepped.world, stepped.plans) as folder:
        decisions = learn(args, folder, worlds, network)
        folder.save_driver(network, replace(config, agent_steps=decisions))
        return folder.end()


def learn(args: Args, folder: RunFolder, worlds: CavTorchRLEnv, network: ActorCritic) -> int:
    """Train the network with steps of the worlds; return the number of decisions of the run."""
    learner, curve = Learner(network, args), Curve(folder)
    decisions = folder.began.agent_steps
    if folder.began.parts:  # worlds begin new episodes
        worlds.set_seed(args.seed + curve.updates)
    frames = args.num_worlds * args.num_steps
    collector = Collector(worlds, learner.actor, frames_per_batch=frames, total_frames=-1)
    if parts := folder.resume():
        learner.load(parts["learner"])
        curve.load(parts["curve"])

    def save() -> None:
        folder.save(decisions, curve.updates, {"learner": learner.save(), "curve": curve.save()})

    if not folder.began.parts:
        save()
    steps = iter(collector)
    while decisions < args.total_agent_steps and folder.has_time(args.minutes):
        batch = next(steps)
        decisions += learner.update(batch, max(1.0 - decisions / args.total_agent_steps, 0.0))
        curve.write(batch, decisions)
        if folder.is_due(curve.updates):
            save()
    save()
    collector.shutdown()
    return decisions


def main(words: Sequence[str] | None = None) -> int:
    """Train; return 0: trained, 2: an error, 130: interrupted."""
    return run_program(lambda: train(parse_run(Args, words, __doc__)))


if __name__ == "__main__":
    sys.exit(main())
