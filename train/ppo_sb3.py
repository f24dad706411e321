"""PPO of stable-baselines3 on the same worlds: every agent seat is one of its environments.

    python train/ppo_sb3.py --env merge --minutes 8

The library's own PPO, learning rate, batches and network; what is ours is the view of the worlds
(`cavmarl.adapters.sb3_vec_env`). The run's folder holds stable-baselines3's `model.zip`,
`progress.csv` with the columns of `ippo_torch.py`, and the same network as `model.safetensors` and
`config.json`, which `cavmarl evaluate --policy FOLDER` takes; `manifest.json` says what it was
trained with.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from cavmarl.adapters.sb3_vec_env import CavSb3VecEnv
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
    MAX_DEVIATIONS,
    WEIGHTS_FILE,
    ActorCritic,
    NetworkConfig,
    save_network,
)

MODEL_FILE = "model.zip"


@dataclass(frozen=True)
class Args:
    """The settings of a run; each is an option of the command line."""

    env: Annotated[str, "environment: a name, a folder or a map file"] = "merge"
    num_worlds: Annotated[int, "worlds that are stepped together"] = 32
    seed: Annotated[int, "root of all random numbers"] = 0
    total_agent_steps: Annotated[int, "decisions to learn from, waiting seats included"] = 4_000_000
    minutes: Annotated[float, "stop after this time, whatever is left; 0: no limit"] = 0.0
    num_steps: Annotated[int, "steps of every world between two updates"] = 128
    epochs: Annotated[int, "passes over the decisions of an update"] = 4
    minibatches: Annotated[int, "parts that a pass is cut into"] = 8
    learning_rate: Annotated[float, "of Adam, falling to 0"] = 1e-3
    gamma: Annotated[float, "discount a step"] = 0.99
    hidden: Annotated[int, "width of the two hidden layers"] = 64
    initial_std: Annotated[float, "standard deviation of continuous actions at the start"] = 0.3
    runs: Annotated[str, "folder of all runs"] = "runs"
    name: Annotated[str, "folder of this run; empty: ENV_sb3_SEED"] = ""

    def __post_init__(self) -> None:
        least_one = ("num_worlds", "total_agent_steps", "num_steps", "epochs", "minibatches")
        check_at_least(self, dict.fromkeys(least_one, 1))

    @property
    def folder(self) -> Path:
        """Where this run lies."""
        return run_folder(self.runs, self.name, self.env, "sb3", self.seed)


class Curve(BaseCallback):
    """Writes a line for every update, and stops the run when its time is over.

    Trips that the horizon cut count neither here nor in `ippo_torch.py`.
    """

    def __init__(self, folder: Path, minutes: float) -> None:
        super().__init__()
        self._folder = folder
        self._limit_s = 60.0 * minutes if minutes else float("inf")
        self._ended: deque[tuple[float, bool]] = deque(maxlen=WINDOW)
        self._decisions = self._trips = self._updates = 0

    def _on_training_start(self) -> None:
        self._began_at = time.perf_counter()
        self._log = Log(self._folder)

    def _on_step(self) -> bool:
        infos: list[dict[str, Any]] = self.locals["infos"]
        self._decisions += sum("inactive" not in info for info in infos)
        for info in infos:
            if "episode" in info and not info["TimeLimit.truncated"]:
                self._ended.append((info["episode"]["r"], info["is_success"]))
                self._trips += 1
        return time.perf_counter() - self._began_at < self._limit_s

    def _on_rollout_end(self) -> None:
        self._updates += 1
        seconds = time.perf_counter() - self._began_at
        counts = (self._updates, self._decisions, seconds, self._trips)
        self._log.write(curve_row(*counts, self._ended))

    def _on_training_end(self) -> None:
        self._log.close()


def make_model(args: Args) -> tuple[PPO, VecNormalize]:
    """The library's PPO on our rows."""
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


def save_driver(args: Args, model: PPO, worlds: VecNormalize) -> None:
    """The library's network as one of ours, which is built alike: the seats' driver."""
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
    save_network(args.folder, network, config)


def train(args: Args) -> Path:
    """Run PPO until its decisions or its minutes are used up; returns the folder of the run.

    Raises:
        CavmarlError: settings or an environment that cannot work.
    """
    torch.set_num_threads(1)  # more cost small networks more than they bring
    model, worlds = make_model(args)
    args.folder.mkdir(parents=True, exist_ok=True)
    stepped = worlds.get_attr("worlds")[0]
    begin_training(args.folder, "ppo_sb3.py", asdict(args), stepped.world, stepped.plans)
    model.learn(args.total_agent_steps, Curve(args.folder, args.minutes))
    model.save(args.folder / MODEL_FILE)
    save_driver(args, model, worlds)
    end_training(args.folder, (WEIGHTS_FILE, CONFIG_FILE, CSV_FILE, MODEL_FILE))
    return args.folder


def main(words: Sequence[str] | None = None) -> int:
    """Train; 0: trained, 2: wrong use."""
    return run_program(lambda: train(parse_settings(Args, words, __doc__)))


if __name__ == "__main__":
    sys.exit(main())
