"""`cavmarl demo`: trains and evaluates a driver, and writes a page and videos."""

from __future__ import annotations

import subprocess
import sys
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from cavmarl.cli.evaluate import evaluate_showing, report_table
from cavmarl.cli.output import (
    OUTPUT,
    PAGE_EXTRAS,
    VIDEO_EXTRAS,
    JsonPath,
    Seed,
    about,
    make_folder,
    write_json,
)
from cavmarl.cli.view import drive
from cavmarl.config.registry import find_settings, programs
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError, require_all

EVALUATION_SEED = 1000  # far from the seeds of training
EPISODES = 32
FAILURES = 12  # trips shown in failures.html


def demo(
    minutes: Annotated[float, about("Minutes of training.", metavar="MIN")] = 2.0,
    seconds: Annotated[float, about("Simulated seconds of each video.", metavar="S")] = 60.0,
    out: Annotated[Path, about("Folder for all results.", metavar="DIR", panel=OUTPUT)] = Path(
        "runs/demo"
    ),
    seed: Seed = 0,
    json_path: JsonPath = None,
) -> None:
    """Train the driver `cities_ippo` for `merge`, evaluate it, and make videos."""
    from cavmarl.env.parallel import parallel_env
    from cavmarl.evaluate.page import write_page
    from cavmarl.policies.loading import driver_keys

    if not 0.0 < minutes <= 600.0 or not 0.0 < seconds <= 3600.0:
        raise ConfigError(
            f"--minutes {minutes:g}, --seconds {seconds:g}: --minutes must be above 0 and at most "
            "600, --seconds above 0 and at most 3600"
        )
    needed = {"torch": "train", "sumo": "sumo"}  # the map of town comes with SUMO
    require_all(needed | VIDEO_EXTRAS | PAGE_EXTRAS)
    make_folder(out)
    console = Console()
    console.print(f"[bold]1. train[/] cities_ippo on merge, {minutes:g} min")
    stamp = f"{datetime.now():%Y%m%d-%H%M%S-%f}"
    trained = _train(out, f"driver-{stamp}", minutes, seed)

    console.print("[bold]2. evaluate[/] on merge, on other seeds")
    drivers = {"trained": str(trained), "idm": "idm", "random_actions": "random_actions"}
    keys = driver_keys(trained)
    world = WorldSpec(env="merge", seed=EVALUATION_SEED, overrides=keys)
    folder = out / f"evaluation-{stamp}"
    counts = {"episodes": EPISODES, "failures": FAILURES}
    found = evaluate_showing(console, world, drivers, out=folder, **counts)
    console.print(report_table(found))
    page = out / "demo.html"
    write_page(folder, page)

    console.print(f"[bold]3. drive[/] {seconds:g} s")
    videos = {"merge": str(trained), "town": "idm"}
    stats = {}
    for env, policy in videos.items():
        made = parallel_env(env, render_mode="rgb_array", overrides=keys)
        video = out / f"{env}.mp4"
        stats[env] = drive(made, policy, seconds, EVALUATION_SEED, video, console)
        console.print(f"{Path(policy).name} in {env}: {_traffic(stats[env])}")
    console.print("[bold]made:[/]")
    for path in (trained, page, folder / "failures.html", *(out / f"{env}.mp4" for env in videos)):
        console.print(f"  {path}", highlight=False)
    write_json(
        json_path,
        {
            "driver": str(trained),
            "report": found.to_dict(),
            "page": str(page),
            "traffic": stats,
            "videos": [str(out / f"{env}.mp4") for env in videos],
        },
    )


def _train(out: Path, name: str, minutes: float, seed: int) -> Path:
    """Run the training program and return the folder of the driver."""
    settings = find_settings("train", "demo")
    command = [sys.executable, str(programs()["ppo"]), "--config", str(settings)]
    command += ["--minutes", str(minutes), "--seed", str(seed), "--runs", str(out), "--name", name]
    done = subprocess.run(command, check=False)
    if done.returncode:
        raise typer.Exit(done.returncode)
    return out / name


def _traffic(stats: dict[str, float]) -> str:
    return (
        f"{stats['departed']} departed, {stats['arrived']} arrived, {stats['contacts']} contacts, "
        f"mean speed {stats['mean_speed_mps']:.1f} m/s"
    )
