"""stable-baselines3's PPO on cavmarl's worlds: every agent seat is one of its environments.

    python train/ppo_sb3.py --env merge --minutes 8

The program uses the library's own PPO, learning rate, batches and network; only the adapter is part
of cavmarl (`cavmarl.adapters.sb3_vec_env`). The run's folder has stable-baselines3's `model.zip`,
`progress.csv` with the columns of `ppo.py`, the same network as `model.safetensors` and
`config.json`, which `cavmarl evaluate --policy FOLDER` reads, and `manifest.json` with the
conditions of the training. `--resume FOLDER` continues bit for bit from `checkpoint.pt`.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from cavmarl.adapters.sb3_vec_env import CavSb3VecEnv
from cavmarl.config.registry import load_config
from cavmarl.learning.actor_critic import ActorCritic
from cavmarl.learning.checkpoint import Parts, bytes_of, tensor_of, writing
from cavmarl.learning.log import WINDOW, curve_row
from cavmarl.learning.loggers import logger_names
from cavmarl.learning.options import LOGGERS, RESUME, check_at_least, run_folder, run_program
from cavmarl.learning.run_folder import DRIVER_FILES, RunFolder, parse_run
from cavmarl.networks.network_files import MAX_DEVIATIONS, NetworkConfig

MODEL_FILE = "model.zip"


@dataclass(frozen=True)
class Args:
    """The settings of a run; each is an option of the command line."""

    program: ClassVar[str] = "ppo_sb3.py"

    env: Annotated[str, "environment: a name, a folder or a map file"] = "merge"
    num_worlds: Annotated[int, "number of parallel worlds"] = 32
    seed: Annotated[int, "root of all random numbers"] = 0
    total_agent_steps: Annotated[int, "steps to learn from, also of waiting seats"] = 4_000_000
    minutes: Annotated[float, "stop after this time; 0: no limit"] = 0.0
    num_steps: Annotated[int, "steps per world and update"] = 128
    epochs: Annotated[int, "passes over the decisions of an update"] = 4
    minibatches: Annotated[int, "minibatches per pass"] = 8
    learning_rate: Annotated[float, "learning rate of Adam, annealed to 0"] = 1e-3
    gamma: Annotated[float, "discount per step"] = 0.99
    hidden: Annotated[int, "width of the two hidden layers"] = 64
    initial_std: Annotated[float, "initial standard deviation of continuous actions"] = 0.3
    runs: Annotated[str, "folder of all runs"] = "runs"
    name: Annotated[str, "folder of this run; empty: ENV_sb3_SEED"] = ""
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
        name = (self.name, self.env, "sb3", self.seed)
        return run_folder(self.runs, *name, resume=self.resume)


class Curve(BaseCallback):
    """Writes progress and checkpoints, and stops the run at its time limit.

    Trips that the horizon truncates do not count, as in `ppo.py`.
    """

    def __init__(self, folder: RunFolder, minutes: float) -> None:
        super().__init__()
        self._folder = folder
        self._minutes = minutes
        self._ended: deque[tuple[float, bool]] = deque(maxlen=WINDOW)
        self._decisions = self._trips = 0
        self._updates = folder.began.updates

    def load(self, saved: Parts) -> None:
        """Restore a checkpoint."""
        self._ended.extend(saved["ended"])
        self._decisions, self._trips = saved["decisions"], saved["trips"]

    def _save(self) -> None:
        own = {"ended": [], "decisions": self._decisions, "trips": self._trips}
        own["ended"] = [(float(returned), bool(arrived)) for returned, arrived in self._ended]
        parts = {"curve": own, "model": state_of(self.model)}
        self._folder.save(self.num_timesteps, self._updates, parts)

    def _on_training_start(self) -> None:
        if not self._folder.began.parts:
            self._save()

    def _on_rollout_start(self) -> None:
        if self._updates > self._folder.began.updates and self._folder.is_due(self._updates):
            self._save()

    def _on_step(self) -> bool:
        infos: list[dict[str, Any]] = self.locals["infos"]
        self._decisions += sum("inactive" not in info for info in infos)
        for info in infos:
            if "episode" in info and not info["TimeLimit.truncated"]:
                self._ended.append((info["episode"]["r"], info["is_success"]))
                self._trips += 1
        in_time = self._folder.has_time(self._minutes)
        if not in_time:  # the library would not store these
            self.model._last_obs = self.locals["new_obs"]
            self.model._last_episode_starts = self.locals["dones"]
        return in_time

    def _on_rollout_end(self) -> None:
        self._updates += 1
        counts = (self._updates, self._decisions, self._folder.seconds, self._trips)
        self._folder.log.write(curve_row(*counts, self._ended))

    def _on_training_end(self) -> None:
        self._save()


def state_of(model: Any) -> Parts:
    """Return the state that the next update depends on, except random numbers."""
    worlds, seen = model.env, model.env.obs_rms
    return {
        "parameters": model.get_parameters(),
        "timesteps": model.num_timesteps,
        "observations": torch.from_numpy(model._last_obs),
        "starts": torch.from_numpy(model._last_episode_starts),
        "worlds": tensor_of(worlds.env_method("save_state")[0]),
        "seen": [torch.from_numpy(seen.mean), torch.from_numpy(seen.var), float(seen.count)],
        "returns": torch.from_numpy(worlds.venv.episode_returns),
        "lengths": torch.from_numpy(worlds.venv.episode_lengths),
    }


def put_state(model: Any, saved: Parts) -> None:
    """Restore the state returned by `state_of` in a new model."""
    worlds, seen = model.env, model.env.obs_rms
    model.set_parameters(saved["parameters"])
    model.num_timesteps = saved["timesteps"]
    model._last_obs = saved["observations"].numpy()
    model._last_episode_starts = saved["starts"].numpy()
    worlds.env_method("load_state", bytes_of(saved["worlds"]))
    mean, var, count = saved["seen"]
    seen.mean, seen.var, seen.count = mean.numpy(), var.numpy(), count
    worlds.venv.episode_returns[:] = saved["returns"].numpy()
    worlds.venv.episode_lengths[:] = saved["lengths"].numpy()


def make_model(args: Args) -> tuple[PPO, VecNormalize]:
    """Create the library's PPO on cavmarl's rows."""
    rows = CavSb3VecEnv(args.env, num_worlds=args.num_worlds)
    worlds = VecNormalize(VecMonitor(rows), norm_reward=False, clip_obs=MAX_DEVIATIONS)
    model = PPO(
        "MlpPolicy",
        worlds,
        learning_rate=lambda left: args.learning_rate * left,
        n_steps=args.num_steps,
        batch_size=max(args.num_steps * worlds.num_envs // args.minibatches, 2),
        n_epochs=args.epochs,
        gamma=args.gamma,
        policy_kwargs={
            "net_arch": [args.hidden, args.hidden],
            "log_std_init": float(np.log(args.initial_std)),
        },
        seed=args.seed,
        device="cpu",
    )
    return model, worlds


def save_driver(args: Args, folder: RunFolder, model: PPO, worlds: VecNormalize) -> None:
    """Save the library's network as a driver in cavmarl's form, with equal outputs."""
    env = load_config(args.env)[0]
    config = NetworkConfig(
        environment=env.name,
        observation_size=model.observation_space.shape[0],  # type: ignore[index]
        sensors=env.sensors,
        action=env.action,
        hidden=(args.hidden, args.hidden),
        seed=args.seed,
        agent_steps=model.num_timesteps,
    )
    network = ActorCritic(config)
    theirs = model.policy.state_dict()
    places = {"actor": ("policy_net", "action_net"), "critic": ("value_net", "value_net")}
    weights = {
        f"{ours}.{2 * layer}.{kind}": theirs[
            f"{last}.{kind}" if layer == 2 else f"mlp_extractor.{hidden}.{2 * layer}.{kind}"
        ]
        for ours, (hidden, last) in places.items()
        for layer in range(3)
        for kind in ("weight", "bias")
    }
    if network.continuous:
        weights["log_std"] = theirs["log_std"]
    seen = worlds.obs_rms
    assert isinstance(seen, RunningMeanStd)  # observations are one Box
    weights["mean"] = torch.from_numpy(seen.mean)
    weights["deviation"] = torch.from_numpy(np.sqrt(seen.var + worlds.epsilon))
    network.load_state_dict(weights)
    folder.save_driver(network, config)


def train(args: Args) -> Path:
    """Run PPO until the decisions or minutes are used up; return the folder of the run.

    Raises:
        CavmarlError: the settings or the environment are invalid.
    """
    torch.set_num_threads(1)  # faster for small networks
    model, worlds = make_model(args)
    stepped = worlds.get_attr("worlds")[0]
    with RunFolder(args, stepped.world, stepped.plans) as folder:
        curve = Curve(folder, args.minutes)
        parts = folder.resume()
        if parts:
            put_state(model, parts["model"])
            curve.load(parts["curve"])
        left = args.total_agent_steps - model.num_timesteps
        model.learn(left, curve, reset_num_timesteps=not parts)
        with writing(args.folder / MODEL_FILE):
            model.save(args.folder / MODEL_FILE)
        save_driver(args, folder, model, worlds)
        return folder.end((*DRIVER_FILES, MODEL_FILE))


def main(words: Sequence[str] | None = None) -> int:
    """Train; return 0: trained, 2: an error, 130: interrupted."""
    return run_program(lambda: train(parse_run(Args, words, __doc__)))


if __name__ == "__main__":
    sys.exit(main())
