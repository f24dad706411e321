"""PPO in a single loop on Gymnasium's vector API, in the style of CleanRL.

    python train/ppo_gymnasium.py --env merge --minutes 8

Every agent is a row of `gymnasium.make_vec`. Rows restart in the step after the end of a trip, so
the observation after the last step of a trip is its final observation. The run's folder has the
driver (`model.safetensors` and `config.json`, which `cavmarl evaluate --policy FOLDER` reads),
`progress.csv` with the columns of `ppo.py`, `manifest.json` with the conditions of the training,
and `checkpoint.pt`, from which `--resume FOLDER` continues bit for bit.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics
from numpy.typing import NDArray
from torch import Tensor

from cavmarl.core.errors import ConfigError
from cavmarl.learning.actor_critic import ActorCritic
from cavmarl.learning.checkpoint import Parts, bytes_of, tensor_of
from cavmarl.learning.log import WINDOW, curve_row
from cavmarl.learning.loggers import logger_names
from cavmarl.learning.options import LOGGERS, RESUME, check_at_least, run_folder, run_program
from cavmarl.learning.run_folder import RunFolder, parse_run
from cavmarl.networks.network_files import NetworkConfig


@dataclass(frozen=True)
class Args:
    """The settings of a run; each is an option of the command line."""

    program: ClassVar[str] = "ppo_gymnasium.py"

    env: Annotated[str, "environment: a name from `cavmarl list`"] = "merge"
    num_envs: Annotated[int, "number of rows: agents of all worlds"] = 512
    num_worlds: Annotated[int, "number of parallel worlds"] = 32
    seed: Annotated[int, "root of all random numbers"] = 0
    total_agent_steps: Annotated[int, "decisions to learn from"] = 4_000_000
    minutes: Annotated[float, "stop after this time; 0: no limit"] = 0.0
    num_steps: Annotated[int, "steps per row and update"] = 128
    epochs: Annotated[int, "passes over the decisions of an update"] = 4
    minibatches: Annotated[int, "minibatches per pass"] = 8
    learning_rate: Annotated[float, "learning rate of Adam, annealed to 0"] = 1e-3
    gamma: Annotated[float, "discount per step"] = 0.99
    gae_lambda: Annotated[float, "lambda of generalised advantage estimation"] = 0.95
    clip: Annotated[float, "largest change of the probability ratio"] = 0.2
    hidden: Annotated[int, "width of the two hidden layers"] = 64
    initial_std: Annotated[float, "initial standard deviation of continuous actions"] = 0.3
    runs: Annotated[str, "folder of all runs"] = "runs"
    name: Annotated[str, "folder of this run; empty: ENV_gymnasium_SEED"] = ""
    checkpoint_updates: Annotated[int, "updates between two checkpoints"] = 20
    resume: Annotated[str, RESUME] = ""
    loggers: Annotated[str, LOGGERS] = ""

    def __post_init__(self) -> None:
        least_one = ("total_agent_steps", "num_steps", "epochs", "minibatches")
        check_at_least(self, dict.fromkeys((*least_one, "checkpoint_updates"), 1))
        logger_names(self.loggers)

    @property
    def folder(self) -> Path:
        """The folder of this run."""
        name = (self.name, self.env, "gymnasium", self.seed)
        return run_folder(self.runs, *name, resume=self.resume)


def make_rows(args: Args) -> Any:
    """Create the rows, with wrappers that normalise observations and record trips."""
    begin = f"cavmarl/{args.env}Agents-v"
    name = next((known for known in gymnasium.registry if known.startswith(begin)), "")
    if not name:
        raise ConfigError(f"--env {args.env}: unknown environment; `cavmarl list` shows all names")
    rows = gymnasium.make_vec(
        name,
        num_envs=args.num_envs,
        num_worlds=args.num_worlds,
        autoreset_mode=AutoresetMode.NEXT_STEP,
    )
    return NormalizeObservation(RecordEpisodeStatistics(rows))


class Learner:
    """Collects steps of all rows and trains the network with them.

    Args:
        rows: rows from `make_rows`.
        network: network shared by all rows.
        args: settings of the run.

    Attributes:
        trips: (return, arrived) of the last trips; trips that the horizon truncates do not count.
        num_trips: number of trips so far.
    """

    def __init__(self, rows: Any, network: ActorCritic, args: Args) -> None:
        self._rows, self._network, self._args = rows, network, args
        self._optimizer = torch.optim.Adam(network.parameters(), eps=1e-5)
        observations, infos = rows.reset(seed=args.seed)
        self._observations = torch.from_numpy(observations).float()
        self._active = torch.from_numpy(infos["active"].copy())
        self.trips: deque[tuple[float, bool]] = deque(maxlen=WINDOW)
        self.num_trips = 0

    def save(self) -> Parts:
        """Return the state that later updates depend on, except torch's random numbers."""
        seen = self._rows.obs_rms
        return {
            "network": self._network.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "observations": self._observations,
            "active": self._active,
            "trips": [(float(returned), bool(arrived)) for returned, arrived in self.trips],
            "num_trips": self.num_trips,
            "rows": tensor_of(self._rows.unwrapped.vec.save_state()),
            "seen": [torch.from_numpy(seen.mean), torch.from_numpy(seen.var), float(seen.count)],
            "recorded": {name: torch.from_numpy(array) for name, array in self._recorded().items()},
        }

    def load(self, saved: Parts) -> None:
        """Restore the state returned by `save`."""
        self._network.load_state_dict(saved["network"])
        self._optimizer.load_state_dict(saved["optimizer"])
        self._observations, self._active = saved["observations"], saved["active"]
        self.trips.extend(saved["trips"])
        self.num_trips = saved["num_trips"]
        self._rows.unwrapped.vec.load_state(bytes_of(saved["rows"]))
        mean, var, count = saved["seen"]
        seen = self._rows.obs_rms
        seen.mean, seen.var, seen.count = mean.numpy(), var.numpy(), count
        for name, array in self._recorded().items():
            array[:] = saved["recorded"][name].numpy()

    def _recorded(self) -> dict[str, NDArray[Any]]:
        """Return the trip recorder's data of unfinished trips."""
        names = ("episode_returns", "episode_lengths", "prev_dones")
        return {name: getattr(self._rows.env, name) for name in names}

    def update(self, left: float) -> int:
        """Collect and learn; `left` is the remaining share. Return the number of decisions."""
        with torch.inference_mode():
            steps = self._collect()
        active = steps.pop("active")
        decisions = {name: part[active].clone() for name, part in steps.items()}
        count = len(decisions["rewards"])
        for group in self._optimizer.param_groups:
            group["lr"] = self._args.learning_rate * left
        for _ in range(self._args.epochs):
            for chosen in torch.randperm(count).chunk(self._args.minibatches):
                self._learn({name: part[chosen] for name, part in decisions.items()})
        return count

    def _collect(self) -> dict[str, Tensor]:
        """Return arrays (steps, rows, …), with advantages and returns."""
        kept: list[dict[str, Tensor]] = []
        for _ in range(self._args.num_steps):
            actions, log_probs = self._network.sample(self._observations)
            given = actions.clamp(-1.0, 1.0) if self._network.continuous else actions
            observations, rewards, ended, cut, infos = self._rows.step(given.numpy())
            before, self._observations = self._observations, torch.from_numpy(observations).float()
            kept.append(
                {
                    "observations": before,
                    "actions": actions,
                    "log_probs": log_probs,
                    "active": self._active,
                    "values": self._network.value(before),
                    # Include final observations, because the value of a truncated trip is needed.
                    "next_values": self._network.value(self._observations),
                    "rewards": torch.from_numpy(rewards.copy()),
                    "ended": torch.from_numpy(ended.copy()),
                    "over": torch.from_numpy(ended | cut),
                }
            )
            self._active = torch.from_numpy(infos["active"].copy())
            if ended.any():
                returns = infos["episode"]["r"][ended].tolist()
                self.trips.extend(zip(returns, infos["arrival"][ended] > 0.0, strict=True))
                self.num_trips += len(returns)
        steps = {name: torch.stack([step[name] for step in kept]) for name in kept[0]}
        return self._with_advantages(steps)

    def _with_advantages(self, steps: dict[str, Tensor]) -> dict[str, Tensor]:
        """Add generalised advantages (Schulman et al. 2016), from the last step backwards."""
        after = steps["next_values"] * ~steps["ended"]
        surprises = steps["rewards"] + self._args.gamma * after - steps["values"]
        kept = self._args.gamma * self._args.gae_lambda * ~steps["over"]
        advantages = torch.zeros_like(surprises)
        later = torch.zeros(surprises.shape[1])
        for t in reversed(range(len(surprises))):
            later = advantages[t] = surprises[t] + kept[t] * later
        return steps | {"advantages": advantages, "returns": advantages + steps["values"]}

    def _learn(self, part: dict[str, Tensor]) -> None:
        log_probs, _ = self._network.evaluate(part["observations"], part["actions"])
        advantages = part["advantages"]
        advantages = (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-8)
        ratio = (log_probs - part["log_probs"]).exp()
        clipped = ratio.clamp(1.0 - self._args.clip, 1.0 + self._args.clip)
        policy_loss = -torch.minimum(ratio * advantages, clipped * advantages).mean()
        value_loss = (self._network.value(part["observations"]) - part["returns"]).square().mean()
        self._optimizer.zero_grad()
        loss: Tensor = policy_loss + 0.5 * value_loss
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), max_norm=0.5)
        self._optimizer.step()


def save_driver(folder: RunFolder, network: ActorCritic, config: NetworkConfig, rows: Any) -> None:
    """Save the network, including the normalisation that the wrapper has applied."""
    network.mean.copy_(torch.from_numpy(rows.obs_rms.mean))
    network.deviation.copy_(torch.from_numpy(np.sqrt(rows.obs_rms.var + rows.epsilon)))
    folder.save_driver(network, config)


def train(args: Args) -> Path:
    """Run PPO until the decisions or minutes are used up; return the folder of the run.

    Raises:
        CavmarlError: the settings or the environment are invalid.
    """
    torch.set_num_threads(1)  # faster for small networks
    torch.manual_seed(args.seed)
    rows = make_rows(args)
    env = rows.unwrapped.vec.config
    config = NetworkConfig(
        environment=env.name,
        observation_size=rows.single_observation_space.shape[0],
        sensors=env.sensors,
        action=env.action,
        hidden=(args.hidden, args.hidden),
        seed=args.seed,
    )
    network = ActorCritic(config, initial_std=(args.initial_std, args.initial_std))
    vec = rows.unwrapped.vec
    with RunFolder(args, vec.worlds.world, vec.plans) as folder:
        learner = Learner(rows, network, args)
        decisions, updates = folder.began.agent_steps, folder.began.updates
        if not folder.began.parts:
            folder.save(0, 0, learner.save())
        if parts := folder.resume():
            learner.load(parts)
        while decisions < args.total_agent_steps and folder.has_time(args.minutes):
            decisions += learner.update(max(1.0 - decisions / args.total_agent_steps, 0.0))
            updates += 1
            counts = (updates, decisions, folder.seconds, learner.num_trips)
            folder.log.write(curve_row(*counts, learner.trips))
            if folder.is_due(updates):
                folder.save(decisions, updates, learner.save())
        folder.save(decisions, updates, learner.save())
        save_driver(folder, network, replace(config, agent_steps=decisions), rows)
        return folder.end()


def main(words: Sequence[str] | None = None) -> int:
    """Train; return 0: trained, 2: an error, 130: interrupted."""
    return run_program(lambda: train(parse_run(Args, words, __doc__)))


if __name__ == "__main__":
    sys.exit(main())
