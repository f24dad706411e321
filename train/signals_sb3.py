"""stable-baselines3's PPO for signals: all signals of all worlds share one network.

    python train/signals_sb3.py --env grid4x4.sumocfg

The network scores each green phase of a signal with the same weights, so signals may have any
number of green phases and lanes. Afterwards, the network and the scripted controllers run in worlds
of other seeds, and a table shows their figures. The run's folder has stable-baselines3's
`model.zip`, the figures as `evaluation.json`, and `manifest.json` with the conditions of the
training.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import torch
from rich.console import Console
from stable_baselines3 import PPO

from cavmarl.adapters.sb3_green_policy import GreenPolicy, SharedNetwork
from cavmarl.adapters.sb3_signal_env import CavSb3SignalEnv
from cavmarl.cli.output import parse_settings
from cavmarl.cli.suite import signal_table
from cavmarl.core.progress import counting
from cavmarl.evaluate.signals.signal_meter import SignalFigures
from cavmarl.evaluate.signals.signal_runs import OWN_PROGRAM, run_controller
from cavmarl.learning.checkpoint import writing
from cavmarl.learning.options import check_at_least, run_folder, run_program
from cavmarl.learning.run_folder import RunFolder, parse_run
from cavmarl.signals.controllers import CONTROLLERS, SignalController

MODEL_FILE, FIGURES_FILE = "model.zip", "evaluation.json"
FIRST_SEED = 1000  # first seed of the evaluation
TICK_S = 0.2


@dataclass(frozen=True)
class Args:
    """The settings of a run; each is an option of the command line."""

    program: ClassVar[str] = "signals_sb3.py"

    env: Annotated[str, "environment: a name, a folder, a map file or a .sumocfg"] = "grid4x4"
    num_worlds: Annotated[int, "number of parallel worlds"] = 4
    background: Annotated[int, "generated background vehicles; -1: as in the environment"] = -1
    agents: Annotated[int, "vehicles that are agents in the training"] = 0
    drivers: Annotated[str, "policy of these vehicles; empty: the built-in driver"] = ""
    settings: Annotated[str, "other keys of the environment: KEY=VALUE, comma-separated"] = ""
    horizon_s: Annotated[int, "seconds of an episode"] = 3600
    seed: Annotated[int, "root of all random numbers"] = 0
    updates: Annotated[int, "updates of the network"] = 60
    num_steps: Annotated[int, "decisions of a signal per update"] = 90
    epochs: Annotated[int, "passes over the decisions of an update"] = 4
    minibatches: Annotated[int, "minibatches per pass"] = 10
    learning_rate: Annotated[float, "learning rate of Adam, annealed to 0"] = 1e-3
    gamma: Annotated[float, "discount per decision"] = 0.95
    entropy: Annotated[float, "weight of the entropy in the loss"] = 0.01
    delay_weight: Annotated[float, "weight of the reward's term delay"] = 0.1
    wait_weight: Annotated[float, "weight of the reward's term wait"] = 0.1
    decide_s: Annotated[float, "seconds between two decisions of a signal"] = 5.0
    range_m: Annotated[float, "signals observe lanes with a part within this range, in m"] = 50.0
    hidden: Annotated[int, "width of the hidden layers"] = 64
    compare: Annotated[bool, "run the scripted controllers, too"] = True
    evaluations: Annotated[int, "worlds of the evaluation"] = 5
    runs: Annotated[str, "folder of all runs"] = "runs"
    name: Annotated[str, "folder of this run; empty: ENV_signals_SEED"] = ""

    def __post_init__(self) -> None:
        names = "num_worlds updates num_steps epochs minibatches hidden evaluations"
        check_at_least(self, dict.fromkeys(names.split(), 1))

    @property
    def folder(self) -> Path:
        """The folder of this run."""
        return run_folder(self.runs, self.name, self.env, "signals", self.seed)

    @property
    def overrides(self) -> dict[str, Any]:
        """The changed keys of the environment, for training and evaluation."""
        background = {"population.background": self.background} if self.background >= 0 else {}
        return {
            "clock.sim_dt_s": TICK_S,
            "population.mode": "open",
            **background,
            "signals.decide_s": self.decide_s,
            "signals.max_green_s": 0.0,
            "signals.range_m": self.range_m,
            "signals.terms": {"delay": self.delay_weight, "wait": self.wait_weight},
            **parse_settings([word for word in self.settings.split(",") if word]),
        }


def make_model(args: Args) -> tuple[PPO, CavSb3SignalEnv]:
    """Create stable-baselines3's PPO on the signals of all worlds."""
    step_s = TICK_S if args.agents else args.decide_s
    clock = {"clock.ctrl_dt_s": step_s, "horizon_s": float(args.horizon_s)}
    rows = CavSb3SignalEnv(
        args.env,
        num_worlds=args.num_worlds,
        features="greens",
        spread=True,
        agents=args.agents,
        drivers=args.drivers,
        overrides=args.overrides | clock,
    )
    model = PPO(
        GreenPolicy,
        rows,
        learning_rate=lambda left: args.learning_rate * left,
        n_steps=args.num_steps,
        batch_size=max(args.num_steps * rows.num_envs // args.minibatches, 2),
        n_epochs=args.epochs,
        gamma=args.gamma,
        ent_coef=args.entropy,
        policy_kwargs={"net_arch": [*rows.sizes, args.hidden]},
        seed=args.seed,
        device="cpu",
    )
    return model, rows


def evaluate(args: Args, model: PPO) -> dict[str, list[SignalFigures]]:
    """Run the network and the scripted controllers in worlds of equal seeds."""
    controllers: dict[str, str | SignalController]
    controllers = {"PPO": SharedNetwork(model)}
    if args.compare:
        controllers |= {name: name for name in (OWN_PROGRAM, *CONTROLLERS)}
    found = {}
    with counting(Console(), "controllers") as report:
        for done, (name, controller) in enumerate(controllers.items()):
            report(done, len(controllers))
            found[name] = run_controller(
                args.env,
                controller,
                seconds=args.horizon_s,
                seeds=range(FIRST_SEED, FIRST_SEED + args.evaluations),
                overrides=args.overrides,
            )
    return found


def train(args: Args) -> Path:
    """Train for all updates, and evaluate; return the folder of the run.

    Raises:
        CavmarlError: the settings or the environment are invalid.
    """
    torch.set_num_threads(1)  # faster for small networks
    model, rows = make_model(args)
    with closing(rows), RunFolder(args, rows.get_attr("worlds")[0].world) as folder:
        model.learn(args.updates * args.num_steps * rows.num_envs)
        with writing(args.folder / MODEL_FILE):
            model.save(args.folder / MODEL_FILE)
        figures = evaluate(args, model)
        Console().print(signal_table(Path(args.env).name, figures))
        numbers = {name: [asdict(run) for run in runs] for name, runs in figures.items()}
        with writing(args.folder / FIGURES_FILE):
            (args.folder / FIGURES_FILE).write_text(json.dumps(numbers, indent=1) + "\n")
        return folder.end((MODEL_FILE, FIGURES_FILE))


def main(words: Sequence[str] | None = None) -> int:
    """Train; return 0: trained, 2: an error, 130: interrupted."""
    return run_program(lambda: train(parse_run(Args, words, __doc__)), "trained: {folder}")


if __name__ == "__main__":
    sys.exit(main())
