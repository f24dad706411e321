"""PPO with one network shared by all agents, on batched worlds: IPPO, or MAPPO with `--mappo`.

    python train/ppo.py --env merge --minutes 2
    python train/ppo.py --env town --start cities_ippo --workers 2
    python train/ppo.py --resume runs/merge_ippo_1 --total-agent-steps 8000000
    torchrun --nproc-per-node 2 train/ppo.py --env merge

`Args` has the settings, and `Batch` the decisions. `Collector` drives the worlds, `Learner` updates
the network, and `Run` alternates collecting and learning (Schulman et al. 2017; de Witt et al.
2020; docs/guides/train.md).
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar

import torch
from gymnasium.vector import AutoresetMode
from rich.console import Console
from torch import Tensor, nn

from cavmarl.adapters.observations import refuse_signal_agents
from cavmarl.cli.output import parse_settings
from cavmarl.config.terms import TERMS
from cavmarl.core.errors import ConfigError
from cavmarl.core.extensions import import_plugins
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.learning import options
from cavmarl.learning.actor_critic import ActorCritic
from cavmarl.learning.checkpoint import Parts, bytes_of, tensor_of
from cavmarl.learning.data_parallel import ALONE, Ranks
from cavmarl.learning.log import Trips, describe, mean_of_ranks, progress_bar
from cavmarl.learning.loggers import logger_names
from cavmarl.learning.moving_off import MovingOff, is_held_back, move_off_loss
from cavmarl.learning.observation_norm import Scales
from cavmarl.learning.opponents import Opponents
from cavmarl.learning.phase_times import PhaseTimes
from cavmarl.learning.run_folder import RunFolder, parse_run
from cavmarl.networks.network_files import NetworkConfig
from cavmarl.parallel.worlds.local_worlds import kept_elsewhere
from cavmarl.policies.loading import driver_keys, policy_files

PHASES = ("simulation", "transfer", "inference", "learning")
RED_LIGHT = TERMS.index("red_light")
NUMBERS = ("policy_loss", "value_loss", "entropy", "kl", "clipped")


@dataclass(frozen=True)
class Args:
    """The settings of a run; each is an option of the command line."""

    program: ClassVar[str] = "ppo.py"

    env: Annotated[str, "environment: a name, a folder or a map file"] = "merge"
    agents: Annotated[int, "agents per world; 0: as in the environment"] = 0
    background: Annotated[int, "background vehicles per world; -1: as in the environment"] = -1
    num_envs: Annotated[int, "number of parallel worlds, of all processes together"] = 16
    settings: Annotated[str, "other keys of the environment: KEY=VALUE, comma-separated"] = ""
    plugins: Annotated[str, "modules with terms, sensors, … of your own, comma-separated"] = ""
    zones: Annotated[int, "zones per world; 0: as in the environment"] = 0
    backend: Annotated[str, "place of the worlds: local, processes:N, nodes:N, ray:N, …"] = ""
    workers: Annotated[int, "short form: N for --backend processes:N; 0: see --backend"] = 0
    seed: Annotated[int, "root of all random numbers"] = 0
    total_agent_steps: Annotated[int, "decisions to learn from"] = 4_000_000
    minutes: Annotated[float, "stop after this time; 0: no limit"] = 0.0
    num_steps: Annotated[int, "steps per world and update"] = 128
    epochs: Annotated[int, "passes over the decisions of an update"] = 4
    minibatches: Annotated[int, "minibatches per pass"] = 8
    keep: Annotated[float, "share of decisions to learn from: largest |advantages|"] = 1.0
    learning_rate: Annotated[float, "initial learning rate of Adam"] = 1e-3
    anneal: Annotated[bool, "anneal the learning rate to 0"] = True
    gamma: Annotated[float, "discount per step"] = 0.99
    gae_lambda: Annotated[float, "lambda of generalised advantage estimation"] = 0.95
    clip: Annotated[float, "largest change of the probability ratio"] = 0.2
    entropy_weight: Annotated[float, "weight of the entropy in the loss"] = 0.0
    value_weight: Annotated[float, "weight of the value loss"] = 0.5
    imitate: Annotated[str, "driver to imitate at first; empty: the built-in one"] = ""
    imitation_weight: Annotated[float, "initial weight of the distance to that driver"] = 0.0
    imitation_share: Annotated[float, "share of the run in which this weight falls to 0"] = 0.1
    move_off_weight: Annotated[
        float, "weight of a loss for standing where the built-in driver would go; not at signals"
    ] = 0.0
    start: Annotated[str, "driver to start from: weights, architecture, sensors, actions"] = ""
    end_at_red: Annotated[bool, "end a return when a red light is run, as at a crash"] = False
    opponents: Annotated[str, "drivers of some seats, not learnt from; comma-separated"] = ""
    opponent_share: Annotated[float, "share of the seats of each opponent"] = 0.1
    average: Annotated[float, "share of the driver's averaged weights that an update keeps"] = 0.0
    max_gradient_norm: Annotated[
        float, "largest norm of a gradient; longer gradients are clipped"
    ] = 0.5
    throttle_std: Annotated[float, "initial standard deviation of throttle; without --start"] = 0.3
    steering_std: Annotated[float, "initial standard deviation of steering; without --start"] = 0.1
    mappo: Annotated[bool, "let the critic see the state of the whole world"] = False
    hidden: Annotated[int, "width of the two hidden layers; without --start"] = 128
    shared: Annotated[bool, "one body with LayerNorm for both heads; without --start"] = False
    residual: Annotated[bool, "add actions to the built-in driver's; without --start"] = False
    threads: Annotated[int, "threads of torch"] = 1
    device: Annotated[str, "device of the network: cpu, or cuda with a GPU"] = "cpu"
    checkpoint_updates: Annotated[int, "updates between two checkpoints"] = 20
    runs: Annotated[str, "folder of all runs"] = "runs"
    name: Annotated[str, "folder of this run; empty: ENV_ALGORITHM_SEED"] = ""
    resume: Annotated[str, options.RESUME] = ""
    loggers: Annotated[str, options.LOGGERS] = ""

    def __post_init__(self) -> None:
        ones = "num_envs total_agent_steps num_steps epochs minibatches hidden threads"
        zeros = "agents zones workers seed minutes entropy_weight value_weight"
        zeros += " imitation_weight move_off_weight"
        above = "keep learning_rate clip max_gradient_norm throttle_std steering_std"
        least = dict.fromkeys(f"{ones} checkpoint_updates".split(), 1)
        options.check_at_least(self, least | dict.fromkeys(zeros.split(), 0) | {"background": -1})
        options.check_above_zero(self, [*above.split(), "imitation_share"])
        options.check_shares(self, ("gamma", "gae_lambda", "keep", "opponent_share", "average"))
        options.check_device(self.device)
        logger_names(self.loggers)
        if self.average == 1.0:
            raise ConfigError("--average 1.0: must be below 1; at 1 the driver would not change")
        if self.residual and self.imitation_weight:
            raise ConfigError(
                "--residual: leave out --imitation-weight; the driver starts as the built-in one"
            )
        if self.move_off_weight and (self.residual or self.imitation_weight):
            raise ConfigError(
                "--move-off-weight: leave out --residual and --imitation-weight, which imitate "
                "the built-in driver everywhere"
            )
        if self.shared and self.mappo:
            raise ConfigError("--shared: leave out --mappo, whose critic has other inputs")

    @property
    def folder(self) -> Path:
        name = (self.name, self.env, "mappo" if self.mappo else "ippo", self.seed)
        return options.run_folder(self.runs, *name, self.resume)


@dataclass
class Batch:
    """The data of one collection; T steps, W worlds, A agents."""

    observations: Tensor  # (T, W, A, D)
    states: Tensor  # (T, W, S) states of worlds; S is 0 if the critic does not see them
    actions: Tensor  # (T, W, A, …) as sampled
    log_probs: Tensor  # (T, W, A) log-probabilities of the actions
    values: Tensor  # (T, W, A)
    rewards: Tensor  # (T, W, A)
    acted: Tensor  # (T, W, A) whether the entry is a decision of the network
    next_values: Tensor  # (T, W, A) value after the step; 0 at the end of a trip
    goes_on: Tensor  # (T, W, A) whether entry t + 1 has the same vehicle and episode
    suggested: Tensor | None = None  # (T, W, A, …) actions of the imitated driver, if any

    def advantages(self, gamma: float, gae_lambda: float) -> Tensor:
        """Return (T, W, A) generalised advantages (Schulman et al. 2016); 0 where no agent acted.

        The sums run along the trip of one vehicle and restart where `goes_on` is False.
        """
        deltas = self.rewards + gamma * self.next_values - self.values
        decay = gamma * gae_lambda * self.goes_on
        following = torch.zeros_like(self.values[0])
        advantages = torch.zeros_like(self.values)
        for t in reversed(range(len(deltas))):
            following = (deltas[t] + decay[t] * following) * self.acted[t]
            advantages[t] = following
        return advantages


class Collector:
    """Drives the worlds with a network, stores the decisions, and measures times.

    With a central critic, worlds restart in the step after the end of an episode, because an
    immediate restart would overwrite the last state.

    Attributes:
        opponents: drivers of some vehicles, whose data are not used for training.
    """

    def __init__(
        self, vec: CavVectorEnv, network: ActorCritic, args: Args, seed: int, rank: int = 0
    ) -> None:
        self.vec, self.network, self._args, self._device = vec, network, args, args.device
        self.trips = Trips(vec.num_envs, vec.num_agents)
        self.times = PhaseTimes(PHASES)
        first_world = rank * vec.num_envs
        self._mask = vec.reset(seed=seed, options={"first_world": first_world})[1]["mask"]
        self._observations = torch.from_numpy(vec.worlds.arrays.observations)  # shared
        self.opponents = Opponents(
            args.opponents, vec, args.opponent_share, args.seed + first_world
        )
        self._suggest = self.opponents.example(args.imitate)

    @torch.inference_mode()
    def collect(self, with_suggested: bool) -> Batch:
        """Step all worlds; `with_suggested` also stores the actions of the imitated driver."""
        simulated_s = self.vec.simulated_s
        with self.times.rest("transfer"):
            batch = self._empty(with_suggested)
            self.opponents.begin()
            for t in range(self._args.num_steps):
                self._step(batch, t)
            self._expect(batch)
            self.times.spent_s["simulation"] += self.vec.simulated_s - simulated_s
        return batch

    def _empty(self, with_suggested: bool) -> Batch:
        shape = (self._args.num_steps, *self._mask.shape)
        continuous = self.network.continuous
        numbers = ("log_probs", "values", "rewards", "next_values")
        with torch.device(self._device):
            actions = torch.zeros((*shape, 2)) if continuous else torch.zeros(shape).long()
            return Batch(
                observations=torch.empty((*shape, len(self.network.mean))),
                states=torch.zeros((*shape[:2], self.network.state_size)),
                actions=actions,
                acted=torch.zeros(shape, dtype=torch.bool),
                goes_on=torch.zeros(shape, dtype=torch.bool),
                suggested=torch.zeros_like(actions) if with_suggested else None,
                **{name: torch.zeros(shape) for name in numbers},
            )

    def _step(self, batch: Batch, t: int) -> None:
        """Let the network decide, step the worlds, and fill entry `t` of a batch."""
        if batch.suggested is not None:
            with self.times.of("simulation"):
                batch.suggested[t] = self._suggest(self._observations, self._mask)
        batch.observations[t], batch.states[t] = self._seen(), self._look()
        with self.times.of("inference"):
            output, values = self._heads(batch.observations[t], batch.states[t])
            actions, batch.log_probs[t] = self.network.draw(output)
            batch.values[t], batch.actions[t] = values, actions
            given = self.network.given(actions, batch.observations[t]).cpu().numpy()
        self.opponents.act(self._observations.numpy(), self._mask, given)
        _, reward, ended, cut, infos = self.vec.step(given)
        if self._args.end_at_red:
            ended = ended | (infos["terms"][..., RED_LIGHT] > 0.0)
        ours, self._mask = self.opponents.absent, infos["mask"]
        acted = infos["acted"] & ours
        batch.rewards[t] = torch.from_numpy(reward)
        batch.acted[t] = torch.from_numpy(acted)
        batch.goes_on[t] = torch.from_numpy(acted & self._mask & ~ended & ~cut)
        if len((rows := (cut & ~ended).nonzero())[0]):
            last = torch.from_numpy(infos["final_observations"][rows]).to(self._device)
            # Final observations lack the actions of the built-in driver, so use 0.
            last = nn.functional.pad(last, (0, len(self.network.mean) - last.shape[1]))
            batch.next_values[t][rows] = self.network.value(last, self._look()[rows[0]])
        self.trips.add(reward, infos["vehicle_done"] & ours, cut, infos["terms"])

    def _expect(self, batch: Batch) -> None:
        """Fill `next_values` for the steps of trips that go on."""
        seen = self._seen()
        with self.times.of("inference"):
            after = self._heads(seen.to(self._device), self._look())[1]
        following = torch.cat([batch.values[1:], after[None]])
        batch.next_values = torch.where(batch.goes_on, following, batch.next_values)

    def _seen(self) -> Tensor:
        """Return (W, A, D) observations; if residual, with the built-in driver's actions."""
        if not self.network.residual:
            return self._observations
        with self.times.of("simulation"):
            proposed = torch.from_numpy(self.vec.suggest_actions())
        return torch.cat([self._observations, proposed], dim=-1)

    def _heads(self, observations: Tensor, states: Tensor) -> tuple[Tensor, Tensor]:
        """Return the outputs of actor (W, A, …) and critic (W, A) for all agents of all worlds."""
        each = states[:, None].expand(*observations.shape[:2], states.shape[1])
        return self.network.heads(self.network.normal(observations), each)

    def _look(self) -> Tensor:
        """Return the states (W, S) of the worlds; S is 0 if the critic does not see them."""
        if not self.network.state_size:
            return torch.zeros((self.vec.num_envs, 0), device=self._device)
        return torch.from_numpy(self.vec.state()).to(self._device)

    def save(self) -> Parts:
        """Return the state of worlds and trips."""
        kept: Parts = {"trips": self.trips.save()}
        if not kept_elsewhere(self.vec.config):
            kept["worlds"] = tensor_of(self.vec.save_state())
            kept["mask"] = torch.from_numpy(self._mask)
        return kept

    def load(self, saved: Parts) -> None:
        """Restore the state returned by `save`; worlds without a saved state begin new episodes."""
        self.trips.load(saved["trips"])
        if "worlds" in saved:
            self.vec.load_state(bytes_of(saved["worlds"]))
            self._mask = saved["mask"].numpy()


class Learner:
    """The network, its optimiser, and PPO's update (Schulman et al. 2017).

    Attributes:
        averaged: the network of the driver: an exponential average of the weights after each
            update (Polyak and Juditsky 1992).
    """

    def __init__(
        self,
        network: ActorCritic,
        args: Args,
        ranks: Ranks = ALONE,
        moving_off: MovingOff | None = None,
    ) -> None:
        self.network, self._args, self._ranks = network.to(args.device), args, ranks
        self._moving_off = moving_off
        self.optimizer = torch.optim.Adam(network.parameters(), lr=args.learning_rate, eps=1e-5)
        self.scales = Scales(network, ranks)
        self.averaged = deepcopy(network)

    def imitation_weight(self, left: float) -> float:
        """Return the imitation weight with a share `left` of the run remaining."""
        args = self._args
        return args.imitation_weight * max(1.0 - (1.0 - left) / args.imitation_share, 0.0)

    def update(self, batch: Batch, left: float) -> dict[str, float]:
        """Learn from the decisions of a batch; `left` is the remaining share of the run."""
        args, network = self._args, self.network
        share = left if args.anneal else 1.0
        for group in self.optimizer.param_groups:
            group["lr"] = args.learning_rate * share
        advantages = batch.advantages(args.gamma, args.gae_lambda).flatten()
        acted = batch.acted.flatten().nonzero().squeeze(1)
        reluctant = self._reluctant(batch)
        chosen = self._filtered(advantages, acted, self.imitation_weight(left) > 0.0)
        if reluctant is not None:
            held = acted[reluctant[acted]]
            with torch.no_grad():
                output = network(batch.observations.flatten(0, 2)[held])
            learned = torch.zeros_like(reluctant)
            learned[chosen] = learned[held[is_held_back(output)]] = True
            chosen = learned.nonzero().squeeze(1)
        found: list[Tensor] = []
        for _ in range(args.epochs):
            order = chosen[torch.randperm(len(chosen), device=chosen.device)]
            for rows in order.tensor_split(args.minibatches):
                self.optimizer.zero_grad()
                count = rows.numel() if rows.numel() > 1 else 0  # one row has no std
                if count:
                    found.append(
                        self._differentiate(batch, advantages, reluctant, rows, share, left)
                    )
                if self._ranks.average_gradients(network, count):
                    for part in network.parts:
                        nn.utils.clip_grad_norm_(part, args.max_gradient_norm)
                    self.optimizer.step()
        self.scales.add(batch.observations.flatten(0, 2)[acted])
        self._average()
        means = torch.stack(found or [torch.zeros(len(NUMBERS))]).mean(0)
        of_ranks = self._ranks.gather(means.tolist())
        return {
            name: sum(each) / len(of_ranks) for name, *each in zip(NUMBERS, *of_ranks, strict=True)
        }

    def _reluctant(self, batch: Batch) -> Tensor | None:
        """Return which of all T * W * A decisions should move off; None without that loss."""
        if self._moving_off is None or batch.suggested is None:
            return None
        return self._moving_off.reluctant(
            batch.observations.flatten(0, 2), batch.suggested.flatten(0, 2)
        )

    def _differentiate(
        self,
        batch: Batch,
        advantages: Tensor,
        reluctant: Tensor | None,
        rows: Tensor,
        share: float,
        left: float,
    ) -> Tensor:
        """Compute the gradients of a minibatch; return the values of `NUMBERS`."""
        args, network = self._args, self.network

        def of(values: Tensor) -> Tensor:
            return values.flatten(0, 2)[rows]

        states = batch.states.flatten(0, 1)
        seen = network.normal(of(batch.observations))
        output, values = network.heads(seen, states[rows // batch.acted.shape[2]])
        log_prob, entropy = network.judge(output, of(batch.actions))
        change = log_prob - of(batch.log_probs)
        ratio = change.exp()
        gains = advantages[rows]
        returns = gains + of(batch.values)
        gains = (gains - gains.mean()) / (gains.std() + 1e-8)
        bounded = ratio.clamp(1.0 - args.clip, 1.0 + args.clip)
        policy_loss = -torch.min(gains * ratio, gains * bounded).mean()
        value_loss = (values - returns).square().mean()
        loss = policy_loss + 0.5 * args.value_weight * value_loss
        loss = loss - args.entropy_weight * share * entropy.mean()
        if reluctant is not None:
            loss = loss + args.move_off_weight * move_off_loss(output, reluctant[rows])
        elif batch.suggested is not None:
            distance = network.distance(output, of(batch.suggested))
            loss = loss + self.imitation_weight(left) * distance.mean()
        loss.backward()  # type: ignore[no-untyped-call]
        with torch.no_grad():
            kl = (ratio - 1.0 - change).mean()
            clipped = ((ratio - 1.0).abs() > args.clip).float().mean()
            return torch.stack([policy_loss, value_loss, entropy.mean(), kl, clipped]).detach()

    def _filtered(self, advantages: Tensor, acted: Tensor, all_of_them: bool) -> Tensor:
        """Return rows with the largest |advantages| (Cusumano-Towner et al. 2025), or all rows."""
        if all_of_them or self._args.keep == 1.0:
            return acted
        size = advantages[acted].abs()
        kept = size.topk(max(int(self._args.keep * len(size)), 1), sorted=False).indices
        return acted[kept.sort().values]

    @torch.no_grad()
    def _average(self) -> None:
        """Move the averaged weights towards the new ones, and copy the input normalisation."""
        latest, kept = self.network.state_dict(), self._args.average
        for name, tensor in self.averaged.state_dict().items():
            tensor.lerp_(latest[name], 1.0 if name in ("mean", "deviation") else 1.0 - kept)

    def save(self) -> Parts:
        network, optimizer = self.network.state_dict(), self.optimizer.state_dict()
        averaged = self.averaged.state_dict()
        scales = self.scales.save()
        return {"network": network, "optimizer": optimizer, "scales": scales, "averaged": averaged}

    def load(self, saved: Parts) -> None:
        self.network.load_state_dict(saved["network"])
        self.optimizer.load_state_dict(saved["optimizer"])
        self.averaged.load_state_dict(saved["averaged"])
        self.scales.load(saved["scales"])


class Run:
    """A run of PPO: its state and its main loop."""

    def __init__(self, args: Args, vec: CavVectorEnv, folder: RunFolder, ranks: Ranks) -> None:
        self.args, self.vec, self.folder, self.ranks = args, vec, folder, ranks
        self.agent_steps, self.updates = folder.began.agent_steps, folder.began.updates
        torch.set_num_threads(args.threads)
        torch.manual_seed(args.seed + self.updates)
        self.config = NetworkConfig(
            environment=vec.config.name,
            observation_size=vec.single_observation_space.shape[0] + 2 * args.residual,
            sensors=vec.config.sensors,
            action=vec.config.action,
            hidden=(args.hidden, args.hidden),
            seed=args.seed,
            state_size=vec.state_size if args.mappo else 0,
            shared=args.shared,
            residual=args.residual,
        )
        self.network = ActorCritic(self.config, (args.throttle_std, args.steering_std))
        moving_off = None
        if args.move_off_weight:
            moving_off = MovingOff(vec.config.sensors, vec.config.action)
        self.learner = Learner(self.network, args, ranks, moving_off)
        if args.start and not folder.began.parts:
            self.learner.scales.start(self.config, policy_files(args.start)[0].parent)
        ranks.copy_weights(self.network)
        self.learner.averaged.load_state_dict(self.network.state_dict())
        if ranks.rank:  # processes draw different actions
            torch.manual_seed(args.seed + self.updates + ranks.rank * 1_000_003)
        seed = args.seed + self.updates
        self.collector = Collector(vec, self.network, args, seed, ranks.rank)
        if not folder.began.parts:
            self.save()  # the first checkpoint
        if parts := folder.resume():
            self.learner.load(parts["learner"])
            self.collector.load(parts["collector"])

    def done(self) -> float:
        """The completed share of the run, by decisions or by minutes."""
        done = self.agent_steps / self.args.total_agent_steps
        if self.args.minutes:
            done = max(done, self.folder.seconds / (60.0 * self.args.minutes))
        return self.ranks.of_first(min(done, 1.0))

    def update(self) -> dict[str, float]:
        """Collect, learn and log; return the logged numbers."""
        started, left, collector = time.perf_counter(), 1.0 - self.done(), self.collector
        collector.times.clear()
        suggests = self.learner.imitation_weight(left) > 0.0 or self.args.move_off_weight > 0.0
        batch = collector.collect(suggests)
        with collector.times.of("learning"):
            numbers = self.learner.update(batch, left)
        new = sum(self.ranks.gather(int(batch.acted.sum())))
        self.agent_steps, self.updates = self.agent_steps + new, self.updates + 1
        row = {
            "updates": self.updates,
            "agent_steps": self.agent_steps,
            "seconds": self.folder.seconds,
            "agent_steps_per_s": new / (time.perf_counter() - started),
            **mean_of_ranks(self.ranks.gather(collector.trips.means())),
            **numbers,
            **{f"{phase}_s": seconds for phase, seconds in collector.times.spent_s.items()},
        }
        if self.ranks.rank == 0:
            self.folder.log.write(row)
        return row

    def save(self) -> None:
        """Write a checkpoint and the driver."""
        parts = {"collector": self.collector.save()}
        if self.ranks.rank == 0:
            parts["learner"] = self.learner.save()
        self.folder.save(self.agent_steps, self.updates, parts)
        self.folder.save_driver(
            self.learner.averaged, replace(self.config, agent_steps=self.agent_steps)
        )


@contextmanager
def opened(args: Args, ranks: Ranks = ALONE) -> Iterator[Run]:
    """Open a run with its worlds and its folder, and close them at the end."""
    num_envs = ranks.share("--num-envs", args.num_envs)
    plugins = [word for word in args.plugins.split(",") if word]
    import_plugins(plugins)
    args = options.with_form_of(args, args.start)
    own = driver_keys(args.start) if args.start else {}
    given = parse_settings(options.split_settings(args.settings), plugins)
    vec = make_vec(
        args.env,
        num_envs=num_envs,
        zones=args.zones or None,
        backend=args.backend or None,
        workers=args.workers or None,
        agents=args.agents or None,
        background=None if args.background < 0 else args.background,
        overrides=own | given,
        autoreset_mode=AutoresetMode.NEXT_STEP if args.mappo else AutoresetMode.SAME_STEP,
        copy=False,
    )
    try:
        refuse_signal_agents(vec.config, "this program")
        with ranks, RunFolder(args, vec.worlds.world, vec.plans, ranks) as folder:
            yield Run(args, vec, folder, ranks)
    finally:
        vec.close()


def train(args: Args, console: Console) -> Path:
    """Run PPO until the decisions or minutes are used up; return the folder of the run.

    On SIGTERM, write a checkpoint after the present update, and raise SystemExit.
    """
    ranks = Ranks.of_torchrun()
    console.quiet |= ranks.rank > 0
    with (
        options.noting_sigterm() as was_told,
        opened(args, ranks) as run,
        progress_bar(console) as bar,
    ):
        if run.vec.plans:
            console.print(run.vec.plan_text(), highlight=False)
        task, done = bar.add_task("", total=1.0), run.done() if run.updates else 0.0
        while done < 1.0:
            row = run.update()
            done = run.done()
            ends = done < 1.0 and any(ranks.gather(was_told()))
            if ends or done == 1.0 or run.folder.is_due(run.updates):
                run.save()
            if ends:
                raise SystemExit(128 + signal.SIGTERM)
            bar.update(task, completed=done, description=describe(row))
        return run.folder.end(plans=run.vec.plans)


def main(words: Sequence[str] | None = None) -> int:
    """Train; return 0: trained, 2: an error, 130: interrupted."""
    message = "" if Ranks.of_torchrun().rank else options.DRIVER
    return options.run_program(lambda: train(parse_run(Args, words, __doc__), Console()), message)


if __name__ == "__main__":
    sys.exit(main())
