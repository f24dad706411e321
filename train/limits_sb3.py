"""stable-baselines3's PPO for speed limits: all roadside units of all worlds share one network.

    python train/limits_sb3.py --env lane_drop

The network first imitates the feedback controller, then learns from the rewards.

Afterwards, worlds of other seeds run with the network, with the feedback controller and without
control. A table shows the mean time of a vehicle in the world or waiting to enter, and the number
of arrived vehicles. The run's folder has stable-baselines3's `model.zip`, the figures as
`evaluation.json`, and `manifest.json` with the conditions of the training.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from stable_baselines3 import PPO

from cavmarl import make_vec
from cavmarl.adapters.sb3_signal_env import CavSb3SignalEnv
from cavmarl.bench.harness import make_table
from cavmarl.cli.output import parse_settings
from cavmarl.env.limit_agents import LimitAgents
from cavmarl.evaluate.statistics import mean_interval
from cavmarl.learning.checkpoint import writing
from cavmarl.learning.options import check_at_least, run_folder, run_program
from cavmarl.learning.run_folder import RunFolder, parse_run
from cavmarl.limits.limit_controllers import Feedback

MODEL_FILE, FIGURES_FILE = "model.zip", "evaluation.json"
FIRST_SEED = 1000  # first seed of the evaluation
IMITATION_RATE, IMITATION_PASSES, IMITATION_BATCH = 2e-3, 30, 256
LONGEST_STEP_S = 10.0  # see `clock.ctrl_dt_s`

Choose = Callable[[LimitAgents], NDArray[np.int64]]


@dataclass(frozen=True)
class Args:
    """The settings of a run; each is an option of the command line."""

    program: ClassVar[str] = "limits_sb3.py"

    env: Annotated[str, "environment: a name or a folder"] = "lane_drop"
    decide_s: Annotated[float, "seconds between two decisions of a unit"] = 10.0
    settings: Annotated[str, "other keys of the environment: KEY=VALUE, comma-separated"] = ""
    num_worlds: Annotated[int, "number of parallel worlds"] = 8
    seed: Annotated[int, "root of all random numbers"] = 0
    updates: Annotated[int, "updates of the network"] = 10
    num_steps: Annotated[int, "decisions of a unit per update"] = 180
    epochs: Annotated[int, "passes over the decisions of an update"] = 10
    minibatches: Annotated[int, "minibatches per pass"] = 8
    learning_rate: Annotated[float, "learning rate of Adam, annealed to 0"] = 5e-4
    gamma: Annotated[float, "discount per decision"] = 0.98
    entropy: Annotated[float, "weight of the entropy in the loss"] = 0.005
    imitate: Annotated[
        int, "decisions of the feedback controller that each unit imitates first"
    ] = 360
    hidden: Annotated[int, "width of the two hidden layers"] = 32
    evaluations: Annotated[int, "worlds of the evaluation"] = 16
    runs: Annotated[str, "folder of all runs"] = "runs"
    name: Annotated[str, "folder of this run; empty: ENV_limits_SEED"] = ""

    def __post_init__(self) -> None:
        names = "num_worlds updates num_steps epochs minibatches hidden evaluations"
        check_at_least(self, dict.fromkeys(names.split(), 1))

    @property
    def folder(self) -> Path:
        """The folder of this run."""
        return run_folder(self.runs, self.name, self.env, "limits", self.seed)

    @property
    def overrides(self) -> dict[str, Any]:
        """Keys of the worlds of training and evaluation."""
        return {
            "limits.agents": "all",
            "limits.decide_s": self.decide_s,
            "clock.ctrl_dt_s": self.decide_s / math.ceil(self.decide_s / LONGEST_STEP_S),
            **parse_settings([word for word in self.settings.split(",") if word]),
        }


def make_model(args: Args) -> tuple[PPO, CavSb3SignalEnv]:
    """Create the library's PPO on the units of all worlds."""
    rows = CavSb3SignalEnv(
        args.env, num_worlds=args.num_worlds, kind="limits", spread=True, overrides=args.overrides
    )
    model = PPO(
        "MlpPolicy",
        rows,
        learning_rate=lambda left: args.learning_rate * left,
        n_steps=args.num_steps,
        batch_size=max(args.num_steps * rows.num_envs // args.minibatches, 2),
        n_epochs=args.epochs,
        gamma=args.gamma,
        ent_coef=args.entropy,
        policy_kwargs={"net_arch": [args.hidden, args.hidden]},
        seed=args.seed,
        device="cpu",
    )
    return model, rows


def imitate(args: Args, model: PPO, rows: CavSb3SignalEnv) -> None:
    """Let the network imitate the feedback controller."""
    feedback, units = Feedback(), rows.get_attr("limits")[0]
    seen, chosen = [], []
    observations = np.asarray(rows.reset())
    for _ in range(args.imitate):
        choices = np.maximum(feedback.choose(units.view), 0).reshape(-1)
        seen.append(observations)
        chosen.append(choices)
        observations = np.asarray(rows.step(choices)[0])
    inputs, targets = torch.tensor(np.concatenate(seen)), torch.tensor(np.concatenate(chosen))
    optimizer = torch.optim.Adam(model.policy.parameters(), lr=IMITATION_RATE)
    for _ in range(IMITATION_PASSES):
        for batch in torch.split(torch.randperm(len(inputs)), IMITATION_BATCH):
            _, logarithms, _ = model.policy.evaluate_actions(inputs[batch], targets[batch])
            optimizer.zero_grad()
            (-logarithms.mean()).backward()  # type: ignore[no-untyped-call]
            optimizer.step()


def choices_of(model: PPO) -> Choose:
    """Return a function that returns the most likely choices (W, U) of the network."""

    def choose(units: LimitAgents) -> NDArray[np.int64]:
        seen = units.view.observations
        actions = model.predict(seen.reshape(-1, seen.shape[-1]), deterministic=True)[0]
        return units.keep_beyond(actions.reshape(seen.shape[:2]))

    return choose


def run_worlds(args: Args, choose: Choose) -> dict[str, list[float]]:
    """Run the worlds of the evaluation for an episode; return their figures."""
    vec = make_vec(args.env, num_envs=args.evaluations, agents=0, overrides=args.overrides)
    with closing(vec):
        vec.reset(seed=FIRST_SEED)
        present_s = np.zeros(vec.num_envs)
        for _ in range(vec.max_cycles - 1):
            vec.step({"limits": np.maximum(choose(vec.limits), 0)})
            present_s += [vec.step_s * sum(_present(vec.traffic_stats(w))) for w in _worlds(vec)]
        stats = [vec.traffic_stats(world) for world in _worlds(vec)]
        arrived = [each["arrived"] for each in stats]
        trips = [each["arrived"] + sum(_present(each)) for each in stats]
        return {"time_s": (present_s / np.maximum(trips, 1)).tolist(), "arrived": arrived}


def _present(stats: dict[str, float]) -> tuple[float, float]:
    return stats["running"], stats["waiting"]


def _worlds(vec: Any) -> range:
    return range(vec.num_envs)


def evaluate(args: Args, model: PPO) -> dict[str, dict[str, list[float]]]:
    """Run worlds of equal seeds with the network, with the feedback controller and uncontrolled."""
    feedback = Feedback()
    chosen: dict[str, Choose] = {
        "PPO": choices_of(model),
        "feedback": lambda units: feedback.choose(units.view),
        "no control": lambda units: units.suggest(),
    }
    return {name: run_worlds(args, choose) for name, choose in chosen.items()}


def show(env: str, figures: dict[str, dict[str, list[float]]]) -> None:
    """Print the means over worlds, with 95 % intervals."""
    lines = []
    for name, found in figures.items():
        line = [name]
        for values in found.values():
            interval = mean_interval(np.array(values, dtype=np.float64))
            within = "" if interval is None else f" ± {0.5 * (interval.high - interval.low):.1f}"
            line.append(f"{np.mean(values):.1f}{within}")
        lines.append(line)
    Console().print(make_table(env, ["", "time of a vehicle, s", "arrived"], lines))


def train(args: Args) -> Path:
    """Train for all updates, and evaluate; return the folder of the run.

    Raises:
        CavmarlError: the settings or the environment are invalid.
    """
    torch.set_num_threads(1)  # faster for small networks
    model, rows = make_model(args)
    with closing(rows), RunFolder(args, rows.get_attr("worlds")[0].world) as folder:
        if args.imitate:
            imitate(args, model, rows)
        model.learn(args.updates * args.num_steps * rows.num_envs)
        with writing(args.folder / MODEL_FILE):
            model.save(args.folder / MODEL_FILE)
        figures = evaluate(args, model)
        show(Path(args.env).name, figures)
        with writing(args.folder / FIGURES_FILE):
            (args.folder / FIGURES_FILE).write_text(json.dumps(figures, indent=1) + "\n")
        return folder.end((MODEL_FILE, FIGURES_FILE))


def main(words: Sequence[str] | None = None) -> int:
    """Train; return 0: trained, 2: an error, 130: interrupted."""
    return run_program(lambda: train(parse_run(Args, words, __doc__)), "trained: {folder}")


if __name__ == "__main__":
    sys.exit(main())
