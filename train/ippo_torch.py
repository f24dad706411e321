"""PPO with one network shared by all agents (IPPO), on batched worlds.

    python train/ippo_torch.py --env merge --minutes 2
    python train/ippo_torch.py --config configs/train/merge.yaml
    python train/ippo_torch.py --resume runs/merge_ippo_1 --total-agent-steps 8000000

Every agent learns from its own observations and rewards; all of them share the weights (Schulman et
al. 2017; de Witt et al. 2020). A run's folder holds the driver (`model.safetensors` and
`config.json`, which `cavmarl evaluate --policy FOLDER` takes), `manifest.json` (what it was trained
with), `progress.csv`, TensorBoard's files, and what `--resume` needs. With the same seed, threads
and machine a run repeats itself, unless the clock ends it (`--minutes`). A resumed run begins new
episodes.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import sys
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from pickle import UnpicklingError
from typing import Annotated, Any, get_args, get_type_hints

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from torch import Tensor, nn

from cavmarl.config import TERMS
from cavmarl.config_io import read_yaml, validate
from cavmarl.errors import CavmarlError, ConfigError, PolicyError, require
from cavmarl.evaluate.training_record import begin_training, end_training
from cavmarl.networks import (
    CONFIG_FILE,
    WEIGHTS_FILE,
    ActorCritic,
    NetworkConfig,
    load_network,
    save_network,
)
from cavmarl.vector_env import CavVectorEnv, make_vec

ARRIVAL, COLLISION, OFF_ROAD = (TERMS.index(t) for t in ("arrival", "collision", "off_road"))
WINDOW = 400  # trips
LEAST_DEVIATION = 0.02  # of an observation; those that hardly change are not blown up
OPTIMIZER_FILE = "optimizer.pt"
STATE_FILE = "training.json"
CSV_FILE = "progress.csv"

# Settings that a resumed run may be given anew.
CAN_CHANGE = frozenset(
    "total_agent_steps minutes resume threads workers tensorboard checkpoint_updates".split()
)


@dataclass(frozen=True)
class Args:
    """The settings of a run; each is an option of the command line."""

    env: Annotated[str, "environment: a name, a folder or a map file"] = "merge"
    agents: Annotated[int, "agents a world; 0: as the environment says"] = 0
    background: Annotated[int, "background vehicles a world; -1: as the environment says"] = -1
    num_envs: Annotated[int, "worlds that are stepped together"] = 16
    workers: Annotated[int, "processes that the worlds are shared out over; 0: this one"] = 0
    seed: Annotated[int, "root of all random numbers"] = 0
    total_agent_steps: Annotated[int, "decisions to learn from"] = 4_000_000
    minutes: Annotated[float, "stop after this time, whatever is left; 0: no limit"] = 0.0
    num_steps: Annotated[int, "steps of every world between two updates"] = 128
    epochs: Annotated[int, "passes over the decisions of an update"] = 4
    minibatches: Annotated[int, "parts that a pass is cut into"] = 8
    learning_rate: Annotated[float, "of Adam, at the start"] = 1e-3
    anneal: Annotated[bool, "let the learning rate fall to 0 at the end"] = True
    gamma: Annotated[float, "discount a step"] = 0.99
    gae_lambda: Annotated[float, "of generalised advantage estimation"] = 0.95
    clip: Annotated[float, "how far the ratio of probabilities may leave 1"] = 0.2
    entropy_weight: Annotated[float, "of the entropy in the loss"] = 0.0
    value_weight: Annotated[float, "of the value loss"] = 0.5
    imitation_weight: Annotated[float, "of the distance to the built-in driver, at the start"] = 0.0
    imitation_share: Annotated[float, "share of the run in which that weight falls to 0"] = 0.1
    max_gradient_norm: Annotated[float, "longer gradients are shortened"] = 0.5
    throttle_std: Annotated[float, "standard deviation of the throttle at the start"] = 0.3
    steering_std: Annotated[float, "standard deviation of the steering at the start"] = 0.1
    hidden: Annotated[int, "width of the two hidden layers"] = 128
    threads: Annotated[int, "of torch; more cost small networks more than they bring"] = 1
    checkpoint_updates: Annotated[int, "updates between two checkpoints"] = 20
    runs: Annotated[str, "folder of all runs"] = "runs"
    name: Annotated[str, "folder of this run; empty: ENV_ippo_SEED"] = ""
    resume: Annotated[
        str, "folder of a run to go on with; its settings hold but for the length"
    ] = ""
    tensorboard: Annotated[bool, "write TensorBoard's files"] = False

    def __post_init__(self) -> None:
        at_least = {
            "agents": 0, "background": -1, "num_envs": 1, "workers": 0, "seed": 0,
            "total_agent_steps": 1, "minutes": 0.0, "num_steps": 1, "epochs": 1, "minibatches": 1,
            "entropy_weight": 0.0, "value_weight": 0.0, "imitation_weight": 0.0, "hidden": 1,
            "threads": 1, "checkpoint_updates": 1,
        }  # fmt: skip
        for name, least in at_least.items():
            value = getattr(self, name)
            if not least <= value < float("inf"):
                raise ConfigError(f"--{name.replace('_', '-')} {value}: must be at least {least}")
        for name in (
            "learning_rate",
            "clip",
            "max_gradient_norm",
            "throttle_std",
            "steering_std",
            "imitation_share",
        ):
            if not 0.0 < getattr(self, name) < float("inf"):
                value = getattr(self, name)
                raise ConfigError(f"--{name.replace('_', '-')} {value}: must be above 0")
        for name in ("gamma", "gae_lambda"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                value = getattr(self, name)
                raise ConfigError(f"--{name.replace('_', '-')} {value}: must be from 0 to 1")

    @property
    def folder(self) -> Path:
        """Where this run lies."""
        if self.resume:
            return Path(self.resume)
        stem = Path(self.env).name.split(".")[0]
        return Path(self.runs) / (self.name or f"{stem}_ippo_{self.seed}")


def parse_args(words: Sequence[str] | None = None) -> Args:
    """The settings that the command line asks for; of a resumed run, those that it began with.

    `--config FILE` is a YAML file of the same settings, which options shadow.
    """
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").splitlines()[0], argument_default=argparse.SUPPRESS
    )
    hints = get_type_hints(Args, include_extras=True)
    for field in fields(Args):
        kind, text = get_args(hints[field.name])
        option = f"--{field.name.replace('_', '-')}"
        action: Any = argparse.BooleanOptionalAction if kind is bool else "store"
        extra = {} if kind is bool else {"type": kind, "metavar": kind.__name__.upper()}
        shown = f"{text} (default: {field.default!r})"
        parser.add_argument(option, action=action, help=shown, **extra)
    parser.add_argument("--config", metavar="FILE", type=Path, help="YAML file of these settings")
    given = vars(parser.parse_args(words))
    config = given.pop("config", None)
    if not given.get("resume"):
        return replace(
            validate(Args, read_yaml(config), str(config)) if config else Args(), **given
        )
    if refused := given.keys() - CAN_CHANGE:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in sorted(refused))
        raise ConfigError(f"{names}: cannot change when a run is resumed")
    return replace(read_state(Path(given["resume"])).args, **given)


@dataclass(frozen=True)
class State:
    """How far a run has come.

    Attributes:
        args: its settings.
        agent_steps: decisions that it learned from.
        updates: of the network.
        seconds: spent on them.
    """

    args: Args
    agent_steps: int = 0
    updates: int = 0
    seconds: float = 0.0


def read_state(folder: Path) -> State:
    """What `save_checkpoint` noted of a run.

    Raises:
        ConfigError: no checkpoint there, or a broken one.
    """
    path = folder / STATE_FILE
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"--resume {folder}: no checkpoint there ({error.strerror})") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is broken ({error})") from error
    return validate(State, raw, str(path))


@dataclass
class Batch:
    """What one round of `num_steps` steps brought; T steps, W worlds, A agents.

    Attributes:
        observations: (T, W, A, D).
        actions: (T, W, A, …) as sampled.
        log_probs: (T, W, A) of them.
        values: (T, W, A).
        rewards: (T, W, A).
        acted: (T, W, A) which entries are decisions.
        next_values: (T, W, A) what was to be expected after the step; 0 where a vehicle ended.
        goes_on: (T, W, A) whether entry t + 1 is of the same vehicle and episode.
        suggested: (T, W, A, …) what the built-in driver would have done, while it is imitated.
    """

    observations: Tensor
    actions: Tensor
    log_probs: Tensor
    values: Tensor
    rewards: Tensor
    acted: Tensor
    next_values: Tensor
    goes_on: Tensor
    suggested: Tensor | None = None

    def advantages(self, gamma: float, gae_lambda: float) -> Tensor:
        """(T, W, A) generalised advantage estimates; 0 where nobody acted."""
        advantages = torch.zeros_like(self.values)
        following = torch.zeros_like(self.values[0])
        for t in reversed(range(self.values.shape[0])):
            delta = self.rewards[t] + gamma * self.next_values[t] - self.values[t]
            following = delta + gamma * gae_lambda * self.goes_on[t] * following
            following = following * self.acted[t]
            advantages[t] = following
        return advantages


class Scales:
    """Keeps the network's mean and deviation of observations: of all decisions of a run so far.

    Args:
        network: whose `mean` and `deviation` are kept.
        count: decisions that they are of already.
    """

    def __init__(self, network: ActorCritic, count: int) -> None:
        self._network = network
        self._count = count
        self._squares = network.deviation.square() * count

    def add(self, observations: Tensor) -> None:
        """Take in the observations (N, D) of new decisions (Chan et al. 1979)."""
        network, new = self._network, observations.shape[0]
        if new == 0:
            return
        mean = observations.mean(0)
        apart = mean - network.mean
        total = self._count + new
        self._squares += (observations - mean).square().sum(0)
        self._squares += apart.square() * (self._count * new / total)
        network.mean += apart * (new / total)
        network.deviation.copy_((self._squares / total).sqrt().clamp(min=LEAST_DEVIATION))
        self._count = total


class Trips:
    """Returns and ends of the last `WINDOW` trips, and those under way in W worlds, A agents."""

    def __init__(self, num_envs: int, num_agents: int) -> None:
        self._returns = np.zeros((num_envs, num_agents))
        self._ended: deque[list[float]] = deque(maxlen=WINDOW)
        self._count = 0

    def add(
        self, rewards: NDArray[Any], done: NDArray[Any], cut: NDArray[Any], terms: NDArray[Any]
    ) -> None:
        """Take in one step; `done` (W, A) ends trips, `cut` (W, A) forgets them."""
        self._returns += rewards
        ends = terms[done][:, [ARRIVAL, COLLISION, OFF_ROAD]]
        self._ended.extend(np.column_stack([self._returns[done], ends]).tolist())
        self._count += len(ends)
        self._returns[done | cut] = 0.0

    def means(self) -> dict[str, float]:
        """Of the last trips; and how many there have been."""
        names = ("trip_return", "success", "collision", "off_road")
        columns = np.array(self._ended).mean(axis=0) if self._ended else np.full(4, np.nan)
        return {"trips": self._count, **dict(zip(names, columns.tolist(), strict=True))}


class Collector:
    """Drives the worlds with the network and keeps what comes of it."""

    def __init__(self, vec: CavVectorEnv, network: ActorCritic, args: Args, seed: int) -> None:
        self.vec = vec
        self.network = network
        self.trips = Trips(vec.num_envs, vec.num_agents)
        self._num_steps = args.num_steps
        self._observations, infos = vec.reset(seed=seed)
        self._mask: NDArray[np.bool_] = infos["mask"]

    @torch.inference_mode()
    def collect(self, with_suggested: bool) -> Batch:
        """`num_steps` steps of all worlds, on request with what the built-in driver would do."""
        shape = (self._num_steps, *self._mask.shape)
        network, continuous = self.network, self.network.continuous
        observations = torch.zeros((*shape, self._observations.shape[-1]))
        actions = torch.zeros((*shape, 2)) if continuous else torch.zeros(shape, dtype=torch.int64)
        log_probs, rewards, next_values = (torch.zeros(shape) for _ in range(3))
        acted, goes_on, cut = (torch.zeros(shape, dtype=torch.bool) for _ in range(3))
        suggested = torch.zeros_like(actions) if with_suggested else None
        for t in range(self._num_steps):
            if suggested is not None:
                suggested[t] = torch.from_numpy(self.vec.suggest_actions())
            mask = torch.from_numpy(self._mask)
            observations[t] = torch.from_numpy(self._observations)
            sampled, log_prob = network.sample(observations[t, mask])
            actions[t, mask] = sampled
            log_probs[t, mask] = log_prob
            given = actions[t].clamp(-1.0, 1.0) if continuous else actions[t]
            self._observations, reward, ended, cut_off, infos = self.vec.step(given.numpy())
            self._mask = infos["mask"]
            rewards[t] = torch.from_numpy(reward)
            acted[t] = torch.from_numpy(infos["acted"])
            cut[t] = torch.from_numpy(cut_off)
            goes_on[t] = torch.from_numpy(infos["acted"] & self._mask & ~ended & ~cut_off)
            if cut_off.any():
                last = torch.from_numpy(infos["final_observations"][cut_off])
                next_values[t, cut[t]] = network.value(last)
            self.trips.add(reward, infos["vehicle_done"], cut_off, infos["terms"])
        values = torch.zeros(shape)
        values[acted] = network.value(observations[acted])
        after = torch.zeros(shape[1:])
        going = goes_on[-1]
        after[going] = network.value(torch.from_numpy(self._observations)[going])
        next_values = torch.where(goes_on, torch.cat([values[1:], after[None]]), next_values)
        return Batch(
            observations,
            actions,
            log_probs,
            values,
            rewards,
            acted,
            next_values,
            goes_on,
            suggested,
        )


class Learner:
    """The network, its optimiser, and PPO's update."""

    def __init__(self, network: ActorCritic, args: Args) -> None:
        self.network = network
        self.optimizer = torch.optim.Adam(network.parameters(), lr=args.learning_rate, eps=1e-5)
        self._args = args

    def imitation_weight(self, left: float) -> float:
        """How much the built-in driver's example counts with `left` of the run to go."""
        args = self._args
        return args.imitation_weight * max(1.0 - (1.0 - left) / args.imitation_share, 0.0)

    def update(self, batch: Batch, left: float) -> dict[str, float]:
        """Learn from the decisions of a batch; `left` is the share of the run that is left."""
        args, network = self._args, self.network
        share = left if args.anneal else 1.0
        rate, entropy_weight = args.learning_rate * share, args.entropy_weight * share
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        acted = batch.acted
        advantages = batch.advantages(args.gamma, args.gae_lambda)
        b_returns = (advantages + batch.values)[acted]
        b_advantages = advantages[acted]
        b_observations = batch.observations[acted]
        b_actions, b_log_probs = batch.actions[acted], batch.log_probs[acted]
        size = b_returns.shape[0]
        imitation_weight = self.imitation_weight(left)
        b_suggested = None if batch.suggested is None else batch.suggested[acted]
        sums = dict.fromkeys(("policy_loss", "value_loss", "entropy", "kl", "clipped"), 0.0)
        parts = 0
        for _ in range(args.epochs):
            for mb in torch.randperm(size).tensor_split(args.minibatches):
                if mb.numel() < 2:  # one decision has no advantage over others
                    continue
                log_prob, entropy = network.evaluate(b_observations[mb], b_actions[mb])
                change = log_prob - b_log_probs[mb]
                ratio = change.exp()
                mb_advantages = b_advantages[mb]
                mb_advantages = (mb_advantages - mb_advantages.mean()) / (
                    mb_advantages.std() + 1e-8
                )
                bounded = ratio.clamp(1.0 - args.clip, 1.0 + args.clip)
                policy_loss = -torch.min(mb_advantages * ratio, mb_advantages * bounded).mean()
                value_loss = (network.value(b_observations[mb]) - b_returns[mb]).square().mean()
                loss = (
                    policy_loss
                    + 0.5 * args.value_weight * value_loss
                    - entropy_weight * entropy.mean()
                )
                if b_suggested is not None:
                    distance = network.distance(b_observations[mb], b_suggested[mb])
                    loss = loss + imitation_weight * distance.mean()
                self.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                for part in (network.actor, network.critic):
                    nn.utils.clip_grad_norm_(part.parameters(), args.max_gradient_norm)
                self.optimizer.step()
                with torch.no_grad():
                    parts += 1
                    sums["policy_loss"] += policy_loss.item()
                    sums["value_loss"] += value_loss.item()
                    sums["entropy"] += entropy.mean().item()
                    sums["kl"] += (ratio - 1.0 - change).mean().item()
                    sums["clipped"] += ((ratio - 1.0).abs() > args.clip).float().mean().item()
        means = {name: value / max(parts, 1) for name, value in sums.items()}
        return {**means, "learning_rate": rate}


def save_checkpoint(folder: Path, learner: Learner, config: NetworkConfig, state: State) -> None:
    """The driver, and what goes on from here; an interrupted write leaves the old files whole."""
    save_network(folder, learner.network, replace(config, agent_steps=state.agent_steps))
    optimizer = folder / f".{OPTIMIZER_FILE}"
    torch.save(learner.optimizer.state_dict(), optimizer)
    os.replace(optimizer, folder / OPTIMIZER_FILE)
    noted = folder / f".{STATE_FILE}"
    noted.write_text(json.dumps(asdict(state), indent=2) + "\n", encoding="utf-8")
    os.replace(noted, folder / STATE_FILE)


def load_checkpoint(folder: Path, learner: Learner, config: NetworkConfig) -> None:
    """Put a run's weights and optimiser into `learner`.

    Raises:
        PolicyError: a broken file, or a run on an environment that has changed since.
    """
    network, saved = load_network(folder)
    if replace(saved, agent_steps=0) != config:
        raise PolicyError(
            f"--resume {folder}: the environment's sensors or actions have changed since that run"
        )
    learner.network.load_state_dict(network.state_dict())
    path = folder / OPTIMIZER_FILE
    try:
        learner.optimizer.load_state_dict(torch.load(path, weights_only=True))
    except (OSError, RuntimeError, ValueError, EOFError, KeyError, UnpicklingError) as error:
        raise PolicyError(f"{path}: cannot be read ({error})") from error


class Log:
    """Writes the numbers of every update to CSV, and to TensorBoard where asked for."""

    def __init__(self, args: Args) -> None:
        path = args.folder / CSV_FILE
        self._file = path.open("a" if args.resume else "w", encoding="utf-8", newline="")
        self._writer: csv.DictWriter[str] | None = None
        self._with_header = not args.resume
        self._board: Any = None
        if args.tensorboard:
            board = require("torch.utils.tensorboard", "torch")
            self._board = board.SummaryWriter(str(args.folder))

    def write(self, row: dict[str, float]) -> None:
        """One update's numbers by name."""
        if self._writer is None:
            self._writer = csv.DictWriter(self._file, list(row))
            if self._with_header:
                self._writer.writeheader()
        self._writer.writerow({name: f"{value:.6g}" for name, value in row.items()})
        self._file.flush()
        if self._board is not None:
            for name, value in row.items():
                self._board.add_scalar(name, value, int(row["agent_steps"]))

    def close(self) -> None:
        """End the files."""
        self._file.close()
        if self._board is not None:
            self._board.close()


def progress_bar(console: Console) -> Progress:
    """A bar over the run, with the numbers that say whether it learns."""
    return Progress(
        TextColumn("{task.percentage:3.0f} %"),
        BarColumn(bar_width=10),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
        console=console,
    )


def make_world(args: Args) -> CavVectorEnv:
    """The worlds that the run learns in."""
    return make_vec(
        args.env,
        num_envs=args.num_envs,
        workers=args.workers,
        agents=args.agents or None,
        background=None if args.background < 0 else args.background,
    )


class Run:
    """A run of PPO: where it stands and how it goes on.

    Args:
        args: its settings.

    Raises:
        CavmarlError: settings, environment or checkpoint that cannot work.
    """

    def __init__(self, args: Args) -> None:
        self.began = read_state(args.folder) if args.resume else State(args)
        self.agent_steps, self.updates = self.began.agent_steps, self.began.updates
        if self.agent_steps >= args.total_agent_steps:
            raise ConfigError(
                f"--total-agent-steps {args.total_agent_steps}: the run has {self.agent_steps}"
            )
        self.args = args
        torch.set_num_threads(args.threads)
        torch.manual_seed(args.seed + self.updates)
        vec = make_world(args)
        self.config = NetworkConfig(
            environment=vec.config.name,
            observation_size=vec.single_observation_space.shape[0],
            sensors=vec.config.sensors,
            action=vec.config.action,
            hidden=(args.hidden, args.hidden),
            seed=args.seed,
        )
        self.network = ActorCritic(self.config, (args.throttle_std, args.steering_std))
        self.learner = Learner(self.network, args)
        if args.resume:
            load_checkpoint(args.folder, self.learner, self.config)
        self.scales = Scales(self.network, self.agent_steps)
        self.collector = Collector(vec, self.network, args, args.seed + self.updates)
        try:
            args.folder.mkdir(parents=True, exist_ok=True)
            begin_training(args.folder, "ippo_torch.py", asdict(args), vec.worlds.world)
            self.log = Log(args)
        except OSError as error:
            reason = error.strerror or error
            raise ConfigError(f"{args.folder}: cannot be written ({reason})") from error
        self._began_at = time.perf_counter()

    def done(self) -> float:
        """The share of the run that is over, by decisions or by the clock."""
        already = self.began.agent_steps
        done = (self.agent_steps - already) / (self.args.total_agent_steps - already)
        if self.args.minutes:
            seconds = time.perf_counter() - self._began_at
            done = max(done, seconds / (60.0 * self.args.minutes))
        return min(done, 1.0)

    def update(self) -> dict[str, float]:
        """Collect, learn, and log the numbers, which are returned."""
        started = time.perf_counter()
        left = 1.0 - self.done()
        batch = self.collector.collect(self.learner.imitation_weight(left) > 0.0)
        numbers = self.learner.update(batch, left)
        self.scales.add(batch.observations[batch.acted])
        new = int(batch.acted.sum())
        self.agent_steps += new
        self.updates += 1
        now = time.perf_counter()
        network = self.network
        row = {
            "updates": self.updates,
            "agent_steps": self.agent_steps,
            "seconds": self.began.seconds + now - self._began_at,
            "agent_steps_per_s": new / (now - started),
            **self.collector.trips.means(),
            **numbers,
            "std": network.log_std.detach().exp().mean().item() if network.continuous else 0.0,
        }
        self.log.write(row)
        return row

    def save(self, row: dict[str, float]) -> None:
        """A checkpoint after the update that gave `row`."""
        args = replace(self.args, resume="")
        state = State(args, self.agent_steps, self.updates, row["seconds"])
        save_checkpoint(self.args.folder, self.learner, self.config, state)


def train(args: Args, console: Console) -> Path:
    """Run PPO until its decisions or its minutes are used up; returns the folder of the run.

    Raises:
        CavmarlError: settings, environment or checkpoint that cannot work.
    """
    run = Run(args)
    with progress_bar(console) as bar:
        task = bar.add_task("", total=1.0)
        done = 0.0
        while done < 1.0:
            row = run.update()
            done = run.done()
            if done == 1.0 or run.updates % args.checkpoint_updates == 0:
                run.save(row)
            bar.update(task, completed=done, description=describe(row))
    run.log.close()
    end_training(args.folder, (WEIGHTS_FILE, CONFIG_FILE, CSV_FILE))
    return args.folder


def describe(row: dict[str, float]) -> str:
    """What a person wants to see of an update: agent-steps, their rate, and the last trips."""
    return (
        f"{row['agent_steps'] / 1e6:.2f} M at {row['agent_steps_per_s'] / 1e3:.0f} k/s · "
        f"return {row['trip_return']:.1f} · success {row['success']:.0%} · "
        f"hit {row['collision']:.0%} · off {row['off_road']:.0%}"
    )


def main(words: Sequence[str] | None = None) -> int:
    """Train; 0: trained, 2: wrong use."""
    try:
        folder = train(parse_args(words), Console())
    except CavmarlError as error:
        Console(stderr=True).print(f"error: {error}", style="red", markup=False)
        return 2
    print(f"driver: {folder}  (cavmarl evaluate ENV --policy {folder})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
