"""`cavmarl demo`: trains and evaluates a driver, and writes a page with moving pictures."""

from __future__ import annotations

import csv
import statistics
import subprocess
import sys
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from rich.console import Console

from cavmarl.cli.evaluate import evaluate_showing
from cavmarl.cli.output import (
    OUTPUT,
    JsonPath,
    Seed,
    about,
    grid,
    make_folder,
    number,
    write_json,
)
from cavmarl.cli.view import drive
from cavmarl.config.io import read_yaml
from cavmarl.config.registry import find_settings, programs
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError, require_all

if TYPE_CHECKING:
    from cavmarl.evaluate import EvaluationReport

NEEDED = ("torch", "matplotlib", "jinja2", "pygame", "PIL")
SETTINGS = "demo"  # in configs/train/
EVALUATION_SEED = 1000  # far from the seeds of training
EPISODES = 32
FAILURES = 12  # trips shown in failures.html
MEASURED = 50_000  # decisions of the training that measures the speed of this machine
# The part after the training takes about as long as training on this number of decisions.
EVALUATION = 500_000
ADAPTED, RULES, RANDOM = "adapted", "idm", "random_actions"
COMPARED = ("success", "collision", "delay_s")


@dataclass(frozen=True)
class DemoTask:
    """The training: the keys of the settings file that the demo shows."""

    env: str
    start: str  # driver before the training
    decisions: int


def demo(
    decisions: Annotated[
        int | None,
        about(
            "Number of decisions to train on [default: as in configs/train/demo.yaml].",
            metavar="N",
        ),
    ] = None,
    seconds: Annotated[
        float, about("Simulated seconds of each moving picture.", metavar="S")
    ] = 30.0,
    out: Annotated[Path, about("Folder for all results.", metavar="DIR", panel=OUTPUT)] = Path(
        "runs/demo"
    ),
    seed: Seed = 0,
    json_path: JsonPath = None,
) -> None:
    """Train a driver for `merge`, compare it with others, and write a page with moving pictures."""
    from cavmarl.evaluate.page import write_page
    from cavmarl.policies.loading import driver_keys

    task = _task(decisions)
    if not 0 < task.decisions <= 10**9 or not 0.0 < seconds <= 120.0:
        raise ConfigError(
            f"--decisions {task.decisions}, --seconds {seconds:g}: --decisions must be from 1 to "
            "1,000,000,000, --seconds above 0 and at most 120"
        )
    require_all(dict.fromkeys(NEEDED, "demo"))
    make_folder(out)
    console = Console(highlight=False)
    console.print("[bold]1. measure[/] the speed of this machine")
    speed = _speed(seed)
    rest_s = EVALUATION / speed
    console.print(
        f"   {speed:,.0f} decisions/s: training takes about {_duration(task.decisions / speed)}, "
        f"evaluation and pictures about {_duration(rest_s)}"
    )
    console.print(f"[bold]2. train[/] {task.start} on {task.env}, {task.decisions:,} decisions")
    stamp = f"{datetime.now():%Y%m%d-%H%M%S-%f}"
    trained = out / f"driver-{stamp}"
    _train(["--runs", str(out), "--name", trained.name], task.decisions, seed)

    console.print(f"[bold]3. evaluate[/] on {task.env}, in episodes that training did not use")
    drivers = {ADAPTED: str(trained), task.start: task.start, RULES: RULES, RANDOM: RANDOM}
    world = WorldSpec(env=task.env, seed=EVALUATION_SEED, overrides=driver_keys(trained))
    folder = out / f"evaluation-{stamp}"
    counts = {"episodes": EPISODES, "failures": FAILURES}
    found = evaluate_showing(console, world, drivers, out=folder, **counts)
    _show(console, found)

    console.print(f"[bold]4. film[/] {seconds:g} s of the driver before and after the training")
    films = {}
    traffic = {}
    for name, policy in ((task.start, task.start), (ADAPTED, str(trained))):
        films[name] = out / f"{name}.webp"
        traffic[name] = _film(world, policy, seconds, films[name], console)
    page = out / "demo.html"
    write_page(folder, page, _story(task, trained, found, films))
    console.print("[bold]made:[/]")
    for path in (page, trained, folder / "failures.html", *films.values()):
        console.print(f"  {path}", markup=False, soft_wrap=True)
    write_json(
        json_path,
        {
            "driver": str(trained),
            "decisions_per_s": speed,
            "report": found.to_dict(),
            "page": str(page),
            "traffic": traffic,
            "films": [str(path) for path in films.values()],
        },
    )


def _task(decisions: int | None) -> DemoTask:
    settings = cast(dict[str, Any], read_yaml(find_settings("train", SETTINGS)))
    trained = settings["total_agent_steps"] if decisions is None else decisions
    return DemoTask(settings["env"], settings["start"], trained)


def _speed(seed: int) -> float:
    """Return the decisions per second of a short training; missing kernels are compiled first."""
    with TemporaryDirectory() as folder:
        run = Path(folder, "measured")
        _train(["--runs", folder, "--name", run.name], MEASURED, seed, is_shown=False)
        with (run / "progress.csv").open(encoding="utf-8", newline="") as file:
            _, *rows = csv.DictReader(file)  # without the first update, which warms up
    return statistics.median(float(row["agent_steps_per_s"]) for row in rows)


def _train(options: list[str], decisions: int, seed: int, is_shown: bool = True) -> None:
    """Run the training program; its output is shown only if it fails or `is_shown`."""
    settings = find_settings("train", SETTINGS)
    command = [sys.executable, str(programs()["ppo"]), "--config", str(settings), *options]
    command += ["--total-agent-steps", str(decisions), "--seed", str(seed)]
    output = None if is_shown else subprocess.DEVNULL
    done = subprocess.run(command, check=False, stdout=output)  # errors go to stderr
    if done.returncode:
        raise typer.Exit(done.returncode)


def _film(
    world: WorldSpec, policy: str, seconds: float, path: Path, console: Console
) -> dict[str, float]:
    """Write a moving picture of a driver; return the traffic statistics."""
    from cavmarl.env.parallel import parallel_env
    from cavmarl.render.animation import AnimationWriter

    made = parallel_env(world.env, render_mode="rgb_array", **world.keywords)
    with closing(made):
        writer = AnimationWriter(path, made.metadata["render_fps"])
        return drive(made, policy, seconds, world.seed, writer, console)


def _show(console: Console, found: EvaluationReport) -> None:
    """Print the main figures of each driver."""
    from cavmarl.evaluate.metrics import METRICS

    shown = [metric for metric in METRICS if metric.name in COMPARED]
    rows = [
        [name, *(number(policy[metric.name].mean, metric.scale) for metric in shown)]
        for name, policy in found.policies.items()
    ]
    console.print(grid(["driver", *(metric.title for metric in shown)], rows))


def _story(task: DemoTask, trained: Path, found: EvaluationReport, films: dict[str, Path]) -> Any:
    """Return the introduction of the page, with the figures of this run."""
    from cavmarl.evaluate.page import Story

    return Story(
        title=f"A driver learns to {task.env}",
        paragraphs=[
            f"The driver {task.start} has learnt to drive on many maps, with its own sensors, but "
            f"never on {task.env}: a busy highway and an on-ramp whose lane ends. It was trained "
            f"further on {task.env} for {task.decisions:,} decisions, by PPO with one network for "
            f"all agents. An agent also receives a share of the reward of its neighbours.",
            f"Then four drivers drove the same {found.episodes} episodes, which training had not "
            f"used: the adapted driver, {task.start} as it was before, {RULES} (the built-in "
            f"driver, which reads the state of the world instead of sensors), and {RANDOM}.",
            compared(found),
        ],
        compared=COMPARED,
        curve=trained / "progress.csv",
        films={f"{task.start}, before": films[task.start], "adapted": films[ADAPTED]},
        commands=[
            (f"cavmarl view {task.env} --policy {trained} --web",
             "Watch the driver in the browser, and drive an agent yourself"),
            (f"cavmarl train ppo --config {SETTINGS} --total-agent-steps {3 * task.decisions}",
             "Train three times as long"),
            (f"cavmarl evaluate {task.env} -p {trained} -p merge_ippo -p {RULES} -n 64 "
             "--seed 2000", "Compare it in other episodes with a driver trained only here"),
            ("cavmarl train ppo --config grid4x4", "Learn to cross sixteen signalled junctions"),
            ("cavmarl list", "List all environments and drivers"),
        ],
    )  # fmt: skip


def compared(found: EvaluationReport) -> str:
    """Return how the adapted driver compares with the built-in one in success and in delay."""
    ours, others = found[ADAPTED], found[RULES]
    success, rules_success = (100.0 * (each["success"].mean or 0.0) for each in (ours, others))
    delay, rules_delay = (each["delay_s"].mean for each in (ours, others))
    text = (
        f"The adapted driver succeeds in {success:.1f} % of its trips, {RULES} in "
        f"{rules_success:.1f} %."
    )
    if delay is None or rules_delay is None:
        return f"{text} At least one of them never arrives, so their delays cannot be compared."
    wins = [
        name
        for name, is_better in (
            ("success", success > rules_success), ("delay", delay < rules_delay)
        )
        if is_better
    ]  # fmt: skip
    return (
        f"{text} Its successful trips take {delay:.1f} s longer than at the speed limits, the "
        f"trips of {RULES} {rules_delay:.1f} s. The adapted driver is better in "
        f"{' and '.join(wins) if wins else 'neither'}; it collides in "
        f"{100.0 * (ours['collision'].mean or 0.0):.1f} % of its trips, {RULES} in "
        f"{100.0 * (others['collision'].mean or 0.0):.1f} %."
    )


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"
