"""TorchRL's PPO on the same worlds: one network shared by all agents (IPPO).

    python train/ippo_torchrl.py --env merge --minutes 8

TorchRL's collector, advantages and clipped loss, on `cavmarl.adapters.torchrl_env`; the network is
ours. The run's folder holds it as `model.safetensors` and `config.json`, which
`cavmarl evaluate --policy FOLDER` takes, `progress.csv` with the columns of `ippo_torch.py`, and
`manifest.json`, which says what it was trained with.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from cavmarl.adapters.torchrl_env import GROUP, CavTorchRLEnv
from cavmarl.config.registry import load_config
from cavmarl.evaluate.provenance.training_record import begin_training, end_training
from cavmarl.learning.log import CSV_FILE, WINDOW, Log, curve_row
from cavmarl.learning.options import (
    check_at_least,
    parse_settings,
    run_folder,
    run_program,
)
from cavmarl.policies.networks import (
    CONFIG_FILE,
    WEIGHTS_FILE,
    ActorCritic,
    NetworkConfig,
    save_network,
)

LEAST_DEVIATION = 0.02  # of an observation; those that hardly change are not blown up
OBSERVATION, MASK, ACTION, LOG_PROB, VALUE = (
    (GROUP, name) for name in ("observation", "mask", "action", "log_prob", "state_value")
)


@dataclass(frozen=True)
class Args:
    """The settings of a run; each is an option of the command line."""

    env: Annotated[str, "environment: a name, a folder or a map file"] = "merge"
    num_worlds: Annotated[int, "worlds that are stepped together"] = 32
    seed: Annotated[int, "root of all random numbers"] = 0
    total_agent_steps: Annotated[int, "decisions to learn from"] = 4_000_000
    minutes: Annotated[float, "stop after this time, whatever is left; 0: no limit"] = 0.0
    num_steps: Annotated[int, "steps of every world between two updates"] = 128
    epochs: Annotated[int, "passes over the decisions of an update"] = 4
    minibatches: Annotated[int, "parts that a pass is cut into"] = 8
    learning_rate: Annotated[float, "of Adam, falling to 0"] = 1e-3
    gamma: Annotated[float, "discount a step"] = 0.99
    gae_lambda: Annotated[float, "discount of the advantages' later terms"] = 0.95
    hidden: Annotated[int, "width of the two hidden layers"] = 64
    initial_std: Annotated[float, "standard deviation of continuous actions at the start"] = 0.3
    runs: Annotated[str, "folder of all runs"] = "runs"
    name: Annotated[str, "folder of this run; empty: ENV_torchrl_SEED"] = ""

    def __post_init__(self) -> None:
        least_one = ("num_worlds", "total_agent_steps", "num_steps", "epochs", "minibatches")
        check_at_least(self, dict.fromkeys(least_one, 1))

    @property
    def folder(self) -> Path:
        """Where this run lies."""
        return run_folder(self.runs, self.name, self.env, "torchrl", self.seed)


class Policy(nn.Module):
    """The policy of a network as TorchRL's distributions take it: means and deviations, or logits.

    Args:
        network: whose policy it is.
    """

    def __init__(self, network: ActorCritic) -> None:
        super().__init__()
        self.network = network

    def forward(self, observations: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Of observations (…, D)."""
        output: Tensor = self.network(observations)
        if not self.network.continuous:
            return output
        return output, self.network.log_std.exp().expand_as(output)


class Value(nn.Module):
    """The value function of a network, with TorchRL's last axis of 1.

    Args:
        network: whose value function it is.
    """

    def __init__(self, network: ActorCritic) -> None:
        super().__init__()
        self.network = network

    def forward(self, observations: Tensor) -> Tensor:
        """Of observations (…, D)."""
        return self.network.value(observations).unsqueeze(-1)


def make_actor(network: ActorCritic) -> ProbabilisticActor:
    """The policy that all agents of a batch of worlds share."""
    names = ("loc", "scale") if network.continuous else ("logits",)
    numbers = {name: (GROUP, name) for name in names}
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
    """The (W, T) steps of worlds as (W · A, T) steps of agents."""
    agents = batch[MASK].shape
    steps = TensorDict({GROUP: batch[GROUP], "next": {GROUP: batch["next", GROUP]}}, agents)
    return steps.transpose(1, 2).reshape(-1, agents[1])


class Learner:
    """Takes batches of steps and improves the network by them.

    Args:
        network: shared by all agents.
        args: of the run.
    """

    def __init__(self, network: ActorCritic, args: Args) -> None:
        self._args = args
        critic = TensorDictModule(Value(network), in_keys=[OBSERVATION], out_keys=[VALUE])
        self.actor = make_actor(network)
        self._advantages = GAE(gamma=args.gamma, lmbda=args.gae_lambda, value_network=critic)
        self._loss = ClipPPOLoss(self.actor, critic, normalize_advantage=True, entropy_coeff=0.0)
        ends = {name: (GROUP, name) for name in ("reward", "done", "terminated")}
        self._advantages.set_keys(value=VALUE, **ends)
        self._loss.set_keys(value=VALUE, action=ACTION, sample_log_prob=LOG_PROB, **ends)
        self._optimizer = torch.optim.Adam(network.parameters(), eps=1e-5)

    def update(self, batch: TensorDict, left: float) -> int:
        """Learn from (W, T) steps; `left` is the share of the run to come. How many decisions."""
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
    """Writes a line for every update. Trips that the horizon cut do not count.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Path) -> None:
        self._log = Log(folder)
        self._ended: deque[tuple[float, bool]] = deque(maxlen=WINDOW)
        self._returns: Any = 0.0
        self._trips = self._updates = 0

    def write(self, batch: TensorDict, decisions: int, seconds: float) -> None:
        """Add an update's line, with the trips that ended in its (W, T) steps."""
        after = batch["next", GROUP]
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
        self._updates += 1
        self._log.write(curve_row(self._updates, decisions, seconds, self._trips, self._ended))

    def close(self) -> None:
        """Close the table."""
        self._log.close()


def make_worlds(args: Args) -> CavTorchRLEnv:
    """The worlds to learn in; what a normal distribution gives beyond ±1 is clipped there."""
    worlds = CavTorchRLEnv(
        args.env,
        num_envs=args.num_worlds,
        overrides={
            "population.mode": "respawn",
            "observation.kind": "flat",
            "action.out_of_range": "clip",
        },
    )
    worlds.set_seed(args.seed)
    return worlds


def make_network(args: Args, worlds: CavTorchRLEnv) -> tuple[ActorCritic, NetworkConfig]:
    """A network that scales observations as its own first steps show them."""
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
    """Run PPO until its decisions or its minutes are used up; returns the folder of the run.

    Raises:
        CavmarlError: settings or an environment that cannot work.
    """
    torch.set_num_threads(1)  # more cost small networks more than they bring
    torch.manual_seed(args.seed)
    worlds = make_worlds(args)
    network, config = make_network(args, worlds)
    args.folder.mkdir(parents=True, exist_ok=True)
    stepped = worlds.vec.worlds
    begin_training(args.folder, "ippo_torchrl.py", asdict(args), stepped.world, stepped.plans)
    learner, curve = Learner(network, args), Curve(args.folder)
    frames = args.num_worlds * args.num_steps
    collector = Collector(worlds, learner.actor, frames_per_batch=frames, total_frames=-1)
    limit_s = 60.0 * args.minutes if args.minutes else float("inf")
    began_at, decisions = time.perf_counter(), 0
    for batch in collector:
        decisions += learner.update(batch, max(1.0 - decisions / args.total_agent_steps, 0.0))
        seconds = time.perf_counter() - began_at
        curve.write(batch, decisions, seconds)
        if decisions >= args.total_agent_steps or seconds >= limit_s:
            break
    collector.shutdown()
    curve.close()
    save_network(args.folder, network, NetworkConfig(**{**vars(config), "agent_steps": decisions}))
    end_training(args.folder, (WEIGHTS_FILE, CONFIG_FILE, CSV_FILE))
    return args.folder


def main(words: Sequence[str] | None = None) -> int:
    """Train; 0: trained, 2: wrong use."""
    return run_program(lambda: train(parse_settings(Args, words, __doc__)))


if __name__ == "__main__":
    sys.exit(main())
