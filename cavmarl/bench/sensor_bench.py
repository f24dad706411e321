"""One vehicle with its sensors over some numbers of sensor workers, each run in processes anew."""

from __future__ import annotations

import json
import os
import random
import signal
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from cavmarl.bench.core_ceiling import CoreCeiling, measure_ceiling
from cavmarl.bench.harness import Result, Say, silent
from cavmarl.bench.sensor_rig import Rig
from cavmarl.bench.sensor_run import PARTS, SensorJob, SensorRun, Window
from cavmarl.bench.sensor_scaling import ScalingRow, Series, scaling_table, summarize
from cavmarl.config.env import EnvConfig
from cavmarl.config.registry import load_config
from cavmarl.core import errors
from cavmarl.core.errors import ConfigError, EvaluationError
from cavmarl.evaluate.provenance.machine import describe_code, describe_hardware, describe_software
from cavmarl.parallel.processes.process_barrier import usable_cores
from cavmarl.parallel.sensor_workers.line_costs import LineCosts
from cavmarl.parallel.sensor_workers.sensor_shares import (
    Shares,
    Unit,
    divide,
    share_by_cost,
    share_in_turn,
)

MAX_WORKERS = 64
PROGRAM = "cavmarl.bench.sensor_run"
CEILING_STEPS, CEILING_TURNS = 10, 7


@dataclass(frozen=True)
class Turn:
    """One run: which it was, and what it found."""

    repeat: int  # from 1
    place: int  # in the order in which all were run, from 1
    workers: int  # sensor workers
    run: SensorRun  # what was found


@dataclass(frozen=True)
class SensorBench(Result):
    """Result of `measure_sensor_workers`."""

    DERIVED: ClassVar = ("sensing_ms", "costs_ms", "is_same")

    env: str  # of which environment
    agents: int  # vehicles with sensors
    background: int  # vehicles without
    warmup: int  # steps that did not count
    steps: int  # of each run that did
    seed: int  # of every run, and of their order
    placement: str  # how sensors were shared out: by `cost` or `in_turn`
    turns: tuple[Turn, ...]  # all runs, in their order
    # how much faster programs that share nothing do the same sensing side by side, as many as the
    # most workers for which there are cores; None: only one
    ceiling: CoreCeiling | None

    def of(self, workers: int) -> list[SensorRun]:
        """The runs with so many sensor workers."""
        return [turn.run for turn in self.turns if turn.workers == workers]

    @property
    def numbers(self) -> list[int]:
        """Of sensor workers."""
        return sorted({turn.workers for turn in self.turns})

    @property
    def rows(self) -> list[ScalingRow]:
        """Every derived figure."""
        series = {
            workers: [Series(run.step_ms, run.wait_ms) for run in self.of(workers)]
            for workers in self.numbers
        }
        return scaling_table(summarize(series))

    @property
    def is_same(self) -> bool:
        """Whether all runs have come to the same states and frames, step by step."""
        return len({turn.run.digests for turn in self.turns}) == 1

    def parts_ms(self, workers: int) -> dict[str, float]:
        """The mean of each part of a step."""
        runs = self.of(workers)
        return {
            name: statistics.fmean(statistics.fmean(run.parts_ms[name]) for run in runs)
            for name in PARTS
        }

    @property
    def sensing_ms(self) -> float:
        """What the sensors take in a tick where the fewest workers share them."""
        runs = self.of(self.numbers[0])
        compute = statistics.fmean(statistics.fmean(run.parts_ms["sensor compute"]) for run in runs)
        return compute / runs[0].ticks_per_step

    @property
    def costs_ms(self) -> list[float]:
        """Of one frame of each sensor, median of all runs."""
        columns = zip(*(turn.run.costs_ms for turn in self.turns), strict=True)
        return [statistics.median(column) for column in columns]

    def shares(self, workers: int) -> dict[str, Shares]:
        """Both ways to share out all sensors of one vehicle, by what they have cost.

        As if all lines of a frame cost the same: dividing frames finds out which cost more.
        """
        costs_ms = self.costs_ms
        num_lines = [sensor["lines"] for sensor in self.turns[0].run.sensors]
        units = [
            Unit(sensor, 0, 1, 0, lines)
            for sensor, (cost_ms, lines) in enumerate(zip(costs_ms, num_lines, strict=True))
            if cost_ms
        ]
        costs_s = [1e-3 * costs_ms[unit.sensor] for unit in units]
        return {
            "in_turn": share_in_turn(units, costs_s, workers),
            "cost": divide(share_by_cost(units, costs_s, workers), LineCosts(num_lines)),
        }

    def windows(self, workers: int) -> list[Window]:
        """Resources of the last run with so many workers."""
        return list(self.of(workers)[-1].windows)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        numbers = self.numbers
        shares = {
            number: {name: asdict(found) for name, found in self.shares(number).items()}
            for number in numbers
        }
        return super().to_dict() | {
            "rows": [row.to_dict() for row in self.rows],
            "ceiling": None if self.ceiling is None else self.ceiling.to_dict(),
            "sd": "sd_within_run is the sample standard deviation (n - 1) of steps within a run",
            "parts_ms": {number: self.parts_ms(number) for number in numbers},
            "shares": shares,
            "hardware": describe_hardware(),
            "software": describe_software(),
            "code": describe_code(),
        }


def measure_sensor_workers(
    env: str | Path,
    rig: Rig,
    *,
    workers: Sequence[int] = (1, 2, 3, 4),
    warmup: int = 40,
    steps: int = 150,
    repeats: int = 5,
    agents: int = 1,
    background: int = 0,
    seed: int = 0,
    overrides: Mapping[str, Any] | None = None,
    say: Say = silent,
) -> SensorBench:
    """Run the same world with each number of sensor workers, in a random order.

    Every run has processes of its own, which share nothing with those of another but files.
    """
    _check(workers, warmup, steps, repeats)
    job = first_job(env, rig, overrides or {}, (agents, background), (warmup, steps), seed)
    order = [(repeat, number) for repeat in range(1, repeats + 1) for number in workers]
    random.Random(seed).shuffle(order)
    turns = []
    for place, (repeat, number) in enumerate(order, 1):
        say(f"run {place} of {len(order)}: {number} sensor workers")
        run = run_job(replace(job, sensor_workers=number))
        turns.append(Turn(repeat, place, number, run))
    return SensorBench(
        env=str(env),
        agents=agents,
        background=background,
        warmup=warmup,
        steps=steps,
        seed=seed,
        placement=job_config(job).workers.sensor_placement,
        turns=tuple(turns),
        ceiling=_ceiling(job, workers, say),
    )


def _ceiling(job: SensorJob, workers: Sequence[int], say: Say) -> CoreCeiling | None:
    """What the machine allows with as many workers as it has cores for; see `SensorBench`."""
    programs = max((number for number in workers if number <= len(usable_cores())), default=1)
    if programs == 1:
        return None
    say(f"{programs} programs that share nothing")
    return measure_ceiling(
        job.env,
        worlds=programs,
        programs=programs,
        steps=CEILING_STEPS,
        repeats=CEILING_TURNS,
        seed=job.seed,
        wanted={name: getattr(job, name) for name in ("agents", "background", "overrides")},
        alike=True,
    )


def _check(workers: Sequence[int], warmup: int, steps: int, repeats: int) -> None:
    if not workers or len(set(workers)) < len(workers) or not 1 <= min(workers) <= max(workers):
        raise ConfigError(f"workers {list(workers)}: must be numbers from 1, each once")
    if max(workers) > MAX_WORKERS:
        raise ConfigError(f"workers {list(workers)}: at most {MAX_WORKERS}")
    if warmup < 0 or steps < 2 or repeats < 1:
        raise ConfigError(
            f"{warmup} steps of warm-up, {steps} steps, {repeats} repeats: must be at least 0, 2 "
            "and 1"
        )


def first_job(
    env: str | Path,
    rig: Rig,
    overrides: Mapping[str, Any],
    vehicles: tuple[int, int],
    steps: tuple[int, int],
    seed: int,
) -> SensorJob:
    """The run with one sensor worker; no episode ends in it, whatever a step is.

    Args:
        env: as in `make_vec`.
        rig: sensors of each agent, by name.
        overrides: values for any other key.
        vehicles: agents, which have the sensors, and others.
        steps: of the warm-up, and those that count.
        seed: root of all random numbers.
    """
    given = {"horizon_s": float(10 * (sum(steps) + 1)), **overrides, "rig": rig}
    return SensorJob(str(env), given, *vehicles, 1, *steps, seed)


def job_config(job: SensorJob) -> EnvConfig:
    """The environment of a run."""
    config, _ = load_config(
        job.env, agents=job.agents, background=job.background, overrides=job.overrides
    )
    return config


def run_job(job: SensorJob) -> SensorRun:
    """A run in a group of processes of its own."""
    program = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-m", PROGRAM],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        process_group=0,
    )
    try:
        said, _ = program.communicate(json.dumps(asdict(job)))
    except BaseException:
        os.killpg(program.pid, signal.SIGKILL)
        program.wait()
        raise
    if program.returncode:
        raise EvaluationError(
            f"a run with {job.sensor_workers} sensor workers ended with exit code "
            f"{program.returncode}; its own message is above"
        )
    told = json.loads(said)
    if "error" in told:
        kind: type[errors.CavmarlError] = getattr(errors, told["error"])
        raise kind.__new__(kind, told["message"])
    return SensorRun(
        **{key: tuple(value) if isinstance(value, list) else value for key, value in told.items()}
        | {
            "windows": tuple(Window(**window) for window in told["windows"]),
            "parts_ms": {name: tuple(values) for name, values in told["parts_ms"].items()},
            "sensors": told["sensors"],
        }
    )
