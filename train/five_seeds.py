"""Training repeated with several seeds; the trained drivers are compared with scripted drivers.

    python train/five_seeds.py --config configs/train/merge.yaml
    python train/five_seeds.py --config configs/train/tasks.yaml --env intersection exit --seeds 0 1

The program runs `ppo.py` with each seed on one core, and evaluates the trained and the scripted
drivers on the same held-out episodes. It writes into the folder `--out`: `table.md`, `result.json`,
`curves.svg`, `evaluation/` with its manifest and raw tables, and the runs, each with its own
manifest. Finished seeds are not trained again; interrupted seeds resume from their checkpoints. If
this program ends for any reason, its trainings end, too.

The interval of a trained driver covers the spread between training seeds. The interval of a
scripted driver covers the spread between evaluation runs. Both are 95 % confidence intervals of the
mean by Student's t, clipped to 0 and 100 % for shares.
`alone` is `idm` without any other vehicle: an upper bound, unless `idm` itself causes failures.
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
GOES_ON = "the same command resumes from the last checkpoints"
SCRIPTED = ("idm", "random_actions")
ALONE = "alone"
METRICS = {
    "success": "success, %",
    "arrived": "arrived, %",
    "collision": "collision, %",
    "off_road": "off road, %",
    "red_light": "red light, %",
    "episode_return": "episode return",
    "delay_s": "delay of arrivals, s",
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
    """Parse the command line into the settings for each environment."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--config", type=Path, required=True, help="settings of ppo.py")
    parser.add_argument("--env", nargs="+", help="environments [default: the config's]")
    parser.add_argument(
        "--settings", default="", help="settings as for ppo.py; used in training only"
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4], help="training seeds"
    )
    parser.add_argument("--jobs", type=int, default=1, help="number of seeds to train in parallel")
    parser.add_argument("--episodes", type=int, default=64, help="episodes per evaluation run")
    parser.add_argument("--repeats", type=int, default=5, help="number of evaluation runs")
    parser.add_argument(
        "--evaluation-seed", type=int, default=1000, help="seed of the first evaluation run"
    )
    parser.add_argument("--out", type=Path, help="folder (default: runs/CONFIG_seeds)")
    parser.add_argument("--others", nargs="*", default=[], help="additional runs to plot")
    given = vars(parser.parse_args(words))
    out = given["out"] or Path("runs") / f"{given['config'].stem}_seeds"
    envs = given["env"] or [env_of(given["config"])]
    if len(set(given["seeds"])) < 2 or given["repeats"] < 2 or given["jobs"] < 1:
        raise ConfigError(
            "--seeds: give at least 2 different seeds, for an interval; --repeats: must be at "
            "least 2; --jobs: must be at least 1"
        )
    return [
        Args(**given | {"env": env, "out": out if len(envs) == 1 else out / Path(env).stem})
        for env in envs
    ]


def env_of(config: Path) -> str:
    """Return the environment in a file of settings."""
    settings = read_yaml(config)
    if not isinstance(settings, dict):
        raise ConfigError(f"{config}: must be a mapping of settings")
    return str(settings.get("env", "merge"))


@dataclass(frozen=True)
class Row:
    """The mean of a driver's metric over runs, with its interval."""

    mean: float | None
    interval: Interval | None
    runs: list[float | None]


def train(args: Args) -> dict[int, Path]:
    """Train or resume each seed unless it is complete; return the folders of the runs by seed."""
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
    """Train with one seed.

    Raises:
        ConfigError: the training has failed.
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
    """Child processes that end with this process, or on request.

    They have their own sessions, so that Ctrl-C reaches only this process.
    """

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = Lock()
        self._are_to_end = False

    def run(self, command: Sequence[str], announcement: str) -> int:
        """Announce and run a child process; return its exit code."""
        with self._lock:
            if self._are_to_end:
                return 0
            child = subprocess.Popen(
                dying_with_parent(command), stdout=subprocess.DEVNULL, start_new_session=True
            )
            self._running.add(child)
        print(f"{announcement}\n", end="", flush=True)  # one write, because several threads print
        try:
            return child.wait()
        finally:
            self._running.discard(child)

    def end(self) -> None:
        """End all child processes; later calls of `run` start none."""
        with self._lock:
            self._are_to_end = True
            for child in tuple(self._running):
                child.kill()


def interval_of(means: NDArray[np.float64], are_shares: bool) -> Interval | None:
    """Return the interval of the mean over training seeds; shares are clipped to [0, 1]."""
    return bounded_interval(means, 0.0) if are_shares else mean_interval(means)


def summarise(
    report: EvaluationReport, alone: EvaluationReport, args: Args
) -> dict[str, dict[str, Row]]:
    """Return rows by driver and metric; `trained` has all seeds, and `alone` is `idm` alone."""
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
    """Return whether the trained drivers' interval lies above that of another driver."""
    mine, theirs = rows["trained"][metric].interval, rows[other][metric].interval
    return mine is not None and theirs is not None and mine.low > theirs.high


def table(rows: Mapping[str, Mapping[str, Row]], args: Args) -> str:
    """Format the result as Markdown."""
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
    """Read the columns of a run's progress.csv."""
    with (folder / "progress.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: [float(row[name]) for row in rows] for name in rows[0]}


def draw_curves(path: Path, folders: Sequence[Path], others: Sequence[Path], title: str) -> None:
    """Plot the learning curves of all seeds, and those of other runs."""
    require("matplotlib", "report")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    axes = figure.subplots(1, 2)
    shown = {"success": "share of trips that arrive", "trip_return": "return per trip"}
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
    """Train on an environment, evaluate the drivers and write the results; return the table."""
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
    """Train, evaluate and write; return 0: done, 2: wrong usage, 130: interrupted."""

    def run() -> None:
        for args in parse_args(words):
            print(compare(args), flush=True)

    return run_to_end(run, GOES_ON)


if __name__ == "__main__":
    sys.exit(main())
