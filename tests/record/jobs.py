"""Jobs: evaluations of one driver in one world, for the commands beside tables of scores.

Several tables show the same driver in the same world, so each such job runs once. Results stay in
runs/record, under the hash of the sources that made them. An interrupted recording continues with
the jobs that it has not finished.
"""

from __future__ import annotations

import hashlib
import json
import shlex
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import typer

from benchmarks import ring22
from cavmarl.cli import app
from cavmarl.cli.output import parse_settings
from cavmarl.cli.report_command import report_command
from cavmarl.config.world_spec import WorldSpec, with_sensors_of_drivers
from cavmarl.core.atomic_file import draft_folder, write_whole
from cavmarl.evaluate import EvaluationReport, evaluate
from cavmarl.evaluate.evaluation import load_report
from cavmarl.evaluate.subprocess_calls import call_in_fresh_process

ROOT = Path(__file__).resolve().parents[2]
EVALUATE, RING22 = "cavmarl evaluate ", "python -m benchmarks ring22 "


@dataclass(frozen=True)
class Job:
    """One driver in seeded episodes of one world."""

    driver: str
    world: WorldSpec
    episodes: int
    repeats: int

    @property
    def key(self) -> str:
        """The name of the folder of results; equal jobs have equal names."""
        text = json.dumps(asdict(self), sort_keys=True)
        return f"{self.world.env}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"

    def drive(self, out: Path) -> None:
        """Evaluate the driver; write the results into the new folder `out`."""
        evaluate(self.world, self.driver, episodes=self.episodes, repeats=self.repeats, out=out)

    def load(self, folder: Path) -> EvaluationReport:
        """Return the report of the results in a folder."""
        return load_report(folder)


@dataclass(frozen=True)
class RingJob:
    """A run of the benchmark `ring22`, which measures all given drivers."""

    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """The name of the folder of results; equal jobs have equal names."""
        text = json.dumps(self.options, sort_keys=True)
        return f"ring22-speed-{hashlib.sha256(text.encode()).hexdigest()[:16]}"

    def drive(self, out: Path) -> None:
        """Run the benchmark; write its rows into the new folder `out`."""
        rows = ring22.measure(**self.options).to_dict()["rows"]
        out.mkdir()
        write_whole(out / "rows.json", json.dumps(rows).encode())

    def load(self, folder: Path) -> dict[str, dict[str, Any]]:
        """Return the rows by driver."""
        rows = json.loads((folder / "rows.json").read_text("utf-8"))
        return {row["driver"]: row for row in rows}


AnyJob = Job | RingJob
Tell = Callable[[str], None]


@cache
def options_of(command: str) -> dict[str, Any]:
    """Return the options of a command; the command's own parser reads and checks them.

    Raises typer's `UsageError` if the command does not have these options.
    """
    words = shlex.split(command)
    if command.startswith(RING22):
        program = typer.Typer()
        program.command()(report_command(ring22.measure))
        return dict(typer.main.get_command(program).make_context("ring22", words[4:]).params)
    assert command.startswith(EVALUATE), f"{command}: neither an evaluation nor ring22"
    found: Any = typer.main.get_command(app)
    return dict(found.commands["evaluate"].make_context("evaluate", words[2:]).params)


def drivers_of(command: str) -> list[str]:
    """Return the drivers of a command in their order."""
    return list(options_of(command)["policy"] or ["idm"])


@cache
def jobs_of(command: str) -> dict[str, AnyJob]:
    """Return the job of each driver of a command; all drivers of an evaluation get one world."""
    options = options_of(command)
    drivers = drivers_of(command)
    if command.startswith(RING22):
        shown = {name: value for name, value in options.items() if name != "json_path"}
        return dict.fromkeys(["human", *drivers], RingJob(shown))
    spec = WorldSpec.of(
        options["env"],
        agents=options["agents"],
        background=options["background"],
        seed=options["seed"],
        overrides=parse_settings(options["settings"]),
        sensors_of=options["sensors_of"],
    )
    world = with_sensors_of_drivers(spec, drivers)
    return {name: Job(name, world, options["episodes"], options["repeats"]) for name in drivers}


def results_folder() -> Path:
    """Return the folder for results of the present code, environments and drivers."""
    digest = hashlib.sha256()
    places = [*ROOT.glob("cavmarl/**/*.py"), *ROOT.glob("benchmarks/ring22.py")]
    places += [path for folder in ("agents", "envs") for path in ROOT.glob(f"{folder}/**/*")]
    for path in sorted(places):
        is_recorded = path.suffix == ".md" or "result" in path.parts
        if is_kept(path) and not is_recorded:
            digest.update(f"{path.relative_to(ROOT)}\0".encode() + path.read_bytes())
    return ROOT / "runs/record" / digest.hexdigest()[:16]


def is_kept(path: Path) -> bool:
    """Return whether a path is a file, and neither bytecode nor an unfinished file."""
    parts = path.relative_to(ROOT).parts
    is_draft = any(part.startswith(".") for part in parts)
    return path.is_file() and not is_draft and "__pycache__" not in parts


def finish(job: AnyJob, place: Path) -> float:
    """Run a job and store its results in `place`; return the duration in seconds."""
    began_s = time.monotonic()
    place.mkdir(parents=True, exist_ok=True)
    with draft_folder(place) as draft:
        job.drive(draft / "out")
        (draft / "out").rename(place / job.key)
    return time.monotonic() - began_s


def finish_all(jobs: Iterable[AnyJob], processes: int, tell: Tell, place: Path) -> dict[str, Any]:
    """Run each job in a fresh process; return the results of all jobs by key.

    Jobs with results in `place` do not run again. After the first error, no further job starts, and
    the error is raised when the running jobs have ended.
    """
    chosen = {job.key: job for job in jobs}
    missing = {key: job for key, job in chosen.items() if not (place / key).is_dir()}
    with ThreadPoolExecutor(processes) as pool:
        running = {
            pool.submit(call_in_fresh_process, key, finish, job, place): key
            for key, job in missing.items()
        }
        try:
            for number, done in enumerate(as_completed(running), start=1):
                tell(f"  {number}/{len(missing)} {running[done]}: {done.result():.0f} s")
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return {key: job.load(place / key) for key, job in chosen.items()}
