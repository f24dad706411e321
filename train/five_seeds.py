"""Training repeated with other seeds, and the drivers that came of it beside scripted ones.

    python train/five_seeds.py --config configs/train/merge.yaml
    python train/five_seeds.py --config configs/train/tasks.yaml --env intersection exit --seeds 0 1

Trains with each seed (`ppo.py`, one core each), lets all drivers and the scripted ones
drive the same episodes, which no training has seen, and writes into the folder: `table.md`,
`result.json`, `curves.svg`, `evaluation/` with its manifest and raw tables, and the runs, each with
its own manifest. A seed that is trained already is not trained again, and one that was cut short
goes on from its checkpoint. Trainings end with this program, however it ends.

Of the trained drivers the interval is that of the mean over training seeds; of a scripted one, that
of the mean over evaluation runs; both 95 %, by Student's t, and of shares within 0 and 100 %.
`alone` is `idm` without any other vehicle: the ceiling, as long as what is missing to it is not the
driver's fault.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.io import read_yaml
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError, require
from cavmarl.core.processes import dying_with_parent
from cavmarl.evaluate import EvaluationReport, evaluate
from cavmarl.evaluate.provenance.training_record import CHECKPOINT_FILE, is_trained
from cavmarl.evaluate.statistics import Interval, bounded_interval, mean_interval
from cavmarl.learning.options import run_to_end
from cavmarl.policies.loading import driver_keys

PROGRAM = Path(__file__).with_name("ppo.py")
GOES_ON = "the same command goes on from the last checkpoints"
SCRIPTED = ("idm", "random_actions")
ALONE = "alone"
METRICS = {
    "success": "success, %",
    "arrived": "arrived, %",
    "collision": "collision, %",
    "off_road": "off road, %",
    "red_light": "red light, %",
    "episode_return": "episode return",
    "delay_s": "delay of an arrival, s",
}
JUDGED = ("success", "episode_return")
PERCENT = frozenset(("success", "arrived", "collision", "off_road", "red_light"))


@dataclass(frozen=True)
class Args:
    """The settings; see `parse_args`."""

    config: Path
    env: str
    settings: str
    seeds: list[int]
    jobs: int
    episodes: int
    repeats: int
    evaluation_seed: int
    out: Path
    others: list[str]


def parse_args(words: Sequence[str] | None = None) -> list[Args]:
    """The settings that the command line asks for, of each environment."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--config", type=Path, required=True, help="settings of ppo.py")
    parser.add_argument("--env", nargs="+", help="one after the other; default: the config's")
    parser.add_argument("--settings", default="", help="as of ppo.py; of the training alone")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4], help="of training")
    parser.add_argument("--jobs", type=int, default=1, help="seeds that are trained side by side")
    parser.add_argument("--episodes", type=int, default=64, help="of an evaluation run")
    parser.add_argument("--repeats", type=int, default=5, help="evaluation runs")
    parser.add_argument("--evaluation-seed", type=int, default=1000, help="of the first of them")
    parser.add_argument("--out", type=Path, help="folder (default: runs/CONFIG_seeds)")
    parser.add_argument("--others", nargs="*", default=[], help="more runs for the curves")
    given = vars(parser.parse_args(words))
    out = given["out"] or Path("runs") / f"{given['config'].stem}_seeds"
    envs = given["env"] or [env_of(given["config"])]
    if len(set(given["seeds"])) < 2 or given["repeats"] < 2 or given["jobs"] < 1:
        raise ConfigError("--seeds and --repeats: an interval needs two; --jobs: at least 1")
    return [
        Args(**given | {"env": env, "out": out if len(envs) == 1 else out / Path(env).stem})
        for env in envs
    ]


def env_of(config: Path) -> str:
    """What the settings in a file train on."""
    settings = read_yaml(config)
    if not isinstance(settings, dict):
        raise ConfigError(f"{config}: must be a mapping of settings")
    return str(settings.get("env", "merge"))


@dataclass(frozen=True)
class Row:
    """A metric of a driver: mean of its runs and the interval of that mean."""

    mean: float | None
    interval: Interval | None
    runs: list[float | None]


def train(args: Args) -> dict[int, Path]:
    """The folder of each seed's run: trained unless it is complete, gone on with if it is begun."""
    folders = {seed: args.out / f"seed_{seed}" for seed in args.seeds}
    missing = [seed for seed in args.seeds if not is_trained(folders[seed])]
    children = Children()
    with ThreadPoolExecutor(args.jobs) as pool:
        try:
            for done in [pool.submit(train_seed, args, seed, children) for seed in missing]:
                done.result()
        except BaseException:
            children.end()
            raise
    return folders


def train_seed(args: Args, seed: int, children: Children) -> None:
    """Train with a seed.

    Raises:
        ConfigError: it has failed.
    """
    folder = args.out / f"seed_{seed}"
    if (folder / CHECKPOINT_FILE).exists():
        words = ["--resume", str(folder)]
    else:
        words = ["--config", str(args.config), "--seed", str(seed), "--runs", str(args.out)]
        words += ["--name", folder.name, "--env", args.env]
        if args.settings:
            words += ["--settings", args.settings]
    command = [sys.executable, str(PROGRAM), *words]
    if children.run(command, f"training seed {seed} on {args.env}"):
        raise ConfigError(f"training with seed {seed} failed: {' '.join(command)}")


class Children:
    """Processes that end with this one, however it ends, or when they are told to.

    They are of sessions of their own: Ctrl-C is for this process.
    """

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = Lock()
        self._are_to_end = False

    def run(self, command: Sequence[str], said: str) -> int:
        """Start one, say so and wait for it: how it has ended."""
        with self._lock:
            if self._are_to_end:
                return 0
            child = subprocess.Popen(
                dying_with_parent(command), stdout=subprocess.DEVNULL, start_new_session=True
            )
            self._running.add(child)
        print(f"{said}\n", end="", flush=True)  # one write: others say so at the same time
        try:
            return child.wait()
        finally:
            self._running.discard(child)

    def end(self) -> None:
        """End all, and start no others."""
        with self._lock:
            self._are_to_end = True
            for child in tuple(self._running):
                child.kill()


def interval_of(means: NDArray[np.float64], are_shares: bool) -> Interval | None:
    """Interval of the mean over training seeds; of shares (0 to 1) it stays within these."""
    return bounded_interval(means, 0.0) if are_shares else mean_interval(means)


def summarise(
    report: EvaluationReport, alone: EvaluationReport, args: Args
) -> dict[str, dict[str, Row]]:
    """Rows by driver and metric; the trained drivers are one. `alone` is a report of `idm`."""
    trained = [report[f"seed_{seed}"] for seed in args.seeds]
    found: dict[str, dict[str, Row]] = {"trained": {}}
    for metric in METRICS:
        means = [driver[metric].mean for driver in trained]
        known = np.array([mean for mean in means if mean is not None])
        mean = float(known.mean()) if known.size else None
        found["trained"][metric] = Row(mean, interval_of(known, metric in PERCENT), means)
    scripted = {name: report[name] for name in SCRIPTED} | {ALONE: alone["idm"]}
    for name, driver in scripted.items():
        found[name] = {
            metric: Row(
                driver[metric].mean,
                driver[metric].between_run_ci95,
                [run.mean for run in driver[metric].within_run],
            )
            for metric in METRICS
        }
    return found


def beats(rows: Mapping[str, Mapping[str, Row]], other: str, metric: str) -> bool:
    """Whether the trained drivers' interval lies above another driver's."""
    mine, theirs = rows["trained"][metric].interval, rows[other][metric].interval
    return mine is not None and theirs is not None and mine.low > theirs.high


def table(rows: Mapping[str, Mapping[str, Row]], args: Args) -> str:
    """The result as Markdown."""
    count = len(args.seeds)
    lines = [
        f"`{args.env}`: {count} training seeds; {args.repeats} runs of {args.episodes} episodes.",
        "",
        "| | " + " | ".join(rows) + " |",
        "| --- |" + " ---: |" * len(rows),
    ]
    for metric, title in METRICS.items():
        cells = [_cell(row[metric], 100.0 if metric in PERCENT else 1.0) for row in rows.values()]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    lines.append("")
    for other in SCRIPTED:
        for metric in JUDGED:
            word = "beats" if beats(rows, other, metric) else "does not beat"
            lines.append(f"- trained {word} {other} in {METRICS[metric]}")
    return "\n".join(lines) + "\n"


def _cell(row: Row, scale: float) -> str:
    if row.mean is None:
        return "-"
    if row.interval is None:
        return f"{scale * row.mean:.2f}"
    low, high = scale * row.interval.low, scale * row.interval.high
    return f"{scale * row.mean:.2f} [{low:.2f}, {high:.2f}]"


def read_curve(folder: Path) -> dict[str, list[float]]:
    """The columns of a run's progress.csv."""
    with (folder / "progress.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: [float(row[name]) for row in rows] for name in rows[0]}


def draw_curves(path: Path, folders: Sequence[Path], others: Sequence[Path], title: str) -> None:
    """Learning curves of all seeds, one line each, and of other runs."""
    require("matplotlib", "report")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    axes = figure.subplots(1, 2)
    shown = {"success": "trips that arrive", "trip_return": "return of a trip"}
    for axis, (column, label) in zip(axes, shown.items(), strict=True):
        for k, folder in enumerate((*folders, *others)):
            curve = read_curve(folder)
            millions = [steps / 1e6 for steps in curve["agent_steps"]]
            name = folder.name if folder in others else "ppo.py" if k == 0 else None
            color = f"C{1 + others.index(folder)}" if folder in others else "C0"
            axis.plot(millions, curve[column], color=color, label=name, linewidth=0.9)
        axis.set(xlabel="decisions, million", ylabel=label)
        axis.grid(color="0.9")
    axes[0].legend(frameon=False)
    figure.suptitle(title)
    figure.savefig(path)


def compare(args: Args) -> str:
    """Train on an environment, evaluate, write; returns the table."""
    args.out.mkdir(parents=True, exist_ok=True)
    folders = train(args)
    drivers = {folder.name: folder for folder in folders.values()}
    keys = driver_keys(folders[args.seeds[0]])
    world = WorldSpec(env=args.env, seed=args.evaluation_seed, overrides=keys)
    policies: dict[str, str | Path] = {**drivers, **{name: name for name in SCRIPTED}}
    episodes, repeats = args.episodes, args.repeats
    out = args.out / "evaluation"
    report = evaluate(world, policies, episodes=episodes, repeats=repeats, out=out)
    alone = replace(world, agents=1, background=0)
    oracle = evaluate(alone, "idm", episodes=episodes, repeats=repeats)
    rows = summarise(report, oracle, args)
    text = table(rows, args)
    (args.out / "table.md").write_text(text, encoding="utf-8")
    plain = {name: {key: asdict(row) for key, row in row.items()} for name, row in rows.items()}
    (args.out / "result.json").write_text(json.dumps(plain, indent=2) + "\n", encoding="utf-8")
    others = [Path(folder) for folder in args.others]
    draw_curves(args.out / "curves.svg", list(folders.values()), others, args.env)
    return text


def main(words: Sequence[str] | None = None) -> int:
    """Train, evaluate, write; 0: done, 2: wrong use, 130: interrupted."""

    def run() -> None:
        for args in parse_args(words):
            print(compare(args), flush=True)

    return run_to_end(run, GOES_ON)


if __name__ == "__main__":
    sys.exit(main())
