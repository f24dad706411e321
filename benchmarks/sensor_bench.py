"""Measure one vehicle with sensors with several numbers of sensor workers, one after another.

Each run has new processes.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean, median
from typing import Any, Unpack

from benchmarks.sensor_run import PARTS, Rig, SensorJob, SensorRun, Window, run_sensors
from benchmarks.sensor_scaling import ScalingRow, Series, scaling_table, summarize
from benchmarks.worker_speed import CoreCeiling, measure_ceiling
from cavmarl.bench.harness import Say, silent
from cavmarl.config.env import EnvConfig
from cavmarl.config.registry import load_config
from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import ConfigError
from cavmarl.core.machine import describe_machine
from cavmarl.evaluate.subprocess_calls import call_in_fresh_process
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
CEILING_STEPS, CEILING_TURNS = 10, 7


@dataclass(frozen=True)
class Turn:
    """One run with its place in the order, and its result."""

    repeat: int  # number of the repetition, from 1
    place: int  # place in the order of all runs, from 1
    workers: int  # number of sensor workers
    run: SensorRun  # result


@dataclass(frozen=True)
class SensorBench:
    """Result of `measure_sensor_workers`."""

    env: str  # name of the environment
    agents: int  # vehicles with sensors
    background: int  # vehicles without sensors
    warmup: int  # unmeasured steps
    steps: int  # measured steps per run
    seed: int  # seed of every run, and of their order
    placement: str  # placement of sensors: by `cost` or `in_turn`
    turns: tuple[Turn, ...]  # all runs, in order
    # speedup of independent programs that run at once: as many as the largest number of sensor
    # workers that is not above the number of cores; None: this number is 1
    ceiling: CoreCeiling | None

    def of(self, workers: int) -> list[SensorRun]:
        """Return the runs with a number of sensor workers."""
        return [turn.run for turn in self.turns if turn.workers == workers]

    @property
    def numbers(self) -> list[int]:
        return sorted({turn.workers for turn in self.turns})

    @property
    def rows(self) -> list[ScalingRow]:
        series = {
            workers: [Series(run.step_ms, run.wait_ms) for run in self.of(workers)]
            for workers in self.numbers
        }
        return scaling_table(summarize(series))

    @property
    def is_same(self) -> bool:
        """Return whether all runs have equal states and frames in each step."""
        return len({turn.run.digests for turn in self.turns}) == 1

    def parts_ms(self, workers: int) -> dict[str, float]:
        runs = self.of(workers)
        return {name: fmean(fmean(run.parts_ms[name]) for run in runs) for name in PARTS}

    @property
    def sensing_ms(self) -> float:
        """Time of the sensors per tick with the fewest workers."""
        least = self.numbers[0]
        return self.parts_ms(least)["sensor compute"] / self.of(least)[0].ticks_per_step

    @property
    def costs_ms(self) -> list[float]:
        """Cost of one frame of each sensor, median of all runs."""
        return [median(of) for of in zip(*(turn.run.costs_ms for turn in self.turns), strict=True)]

    def shares(self, workers: int) -> dict[str, Shares]:
        """Return both placements of all sensors of one vehicle, by their measured costs.

        The placements assume that all lines of a frame (rows of pixels, or rays) have equal costs.
        At run time, the division of frames is corrected by measured costs.
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
        """Return the resources of the last run with a number of workers."""
        return list(self.of(workers)[-1].windows)

    def facts(self) -> dict[str, Any]:
        """Return plain values for a report: all but `rows`."""
        numbers = self.numbers
        shares = {
            number: {name: asdict(found) for name, found in self.shares(number).items()}
            for number in numbers
        }
        return asdict(self) | {
            "sensing_ms": self.sensing_ms,
            "costs_ms": self.costs_ms,
            "is_same": self.is_same,
            "ceiling": None if self.ceiling is None else self.ceiling.facts(),
            "sd": "sd_within_run is the sample standard deviation (n - 1) of steps within a run",
            "parts_ms": {number: self.parts_ms(number) for number in numbers},
            "shares": shares,
            **describe_machine(),
        }


def measure_sensor_workers(
    env: str | Path | WorldSpec,
    rig: Rig,
    *,
    workers: Sequence[int] = (1, 2, 3, 4),
    warmup: int = 40,
    steps: int = 150,
    repeats: int = 5,
    say: Say = silent,
    **keys: Unpack[WorldKeys],
) -> SensorBench:
    """Run the same world with each number of sensor workers, in random order.

    Each run has its own processes, which share only files with other runs. By default, one agent
    has the rig, and there are no other vehicles.
    """
    if not workers or len(set(workers)) < len(workers) or not 1 <= min(workers) <= max(workers):
        raise ConfigError(f"workers {list(workers)}: must be distinct numbers of at least 1")
    if max(workers) > MAX_WORKERS:
        raise ConfigError(f"workers {list(workers)}: must be at most {MAX_WORKERS}")
    if warmup < 0 or steps < 2 or repeats < 1:
        raise ConfigError(
            f"{warmup} steps of warm-up, {steps} steps, {repeats} repeats: must be at least 0, 2 "
            "and 1"
        )
    job = first_job(WorldSpec.of(env, **keys), rig, (warmup, steps))
    spec = job.spec
    order = [(repeat, number) for repeat in range(1, repeats + 1) for number in workers]
    random.Random(spec.seed).shuffle(order)
    turns = []
    for place, (repeat, number) in enumerate(order, 1):
        say(f"run {place} of {len(order)}: {number} sensor workers")
        run = run_job(replace(job, sensor_workers=number))
        turns.append(Turn(repeat, place, number, run))
    return SensorBench(
        env=spec.env,
        agents=spec.agents or 0,
        background=spec.background or 0,
        warmup=warmup,
        steps=steps,
        seed=spec.seed,
        placement=job_config(job).workers.sensor_placement,
        turns=tuple(turns),
        ceiling=_ceiling(spec, workers, say),
    )


def _ceiling(spec: WorldSpec, workers: Sequence[int], say: Say) -> CoreCeiling | None:
    """Measure the machine's limit with as many programs as cores allow; see `SensorBench`."""
    programs = max((number for number in workers if number <= len(usable_cores())), default=1)
    if programs == 1:
        return None
    say(f"{programs} independent programs")
    counts: dict[str, Any] = {"worlds": programs, "programs": programs}
    return measure_ceiling(spec, **counts, steps=CEILING_STEPS, repeats=CEILING_TURNS, alike=True)


def first_job(spec: WorldSpec, rig: Rig, steps: tuple[int, int]) -> SensorJob:
    """Return the run with one sensor worker, in which no episode ends.

    `steps`: unmeasured and measured steps.
    """
    given = {"horizon_s": float(10 * (sum(steps) + 1)), **spec.overrides, "rig": rig}
    agents = 1 if spec.agents is None else spec.agents
    wanted = replace(spec, agents=agents, background=spec.background or 0, overrides=given)
    return SensorJob(wanted, 1, *steps)


def job_config(job: SensorJob) -> EnvConfig:
    return load_config(job.spec.env, **job.spec.keywords)[0]


def run_job(job: SensorJob) -> SensorRun:
    """Run a job in new processes."""
    what = f"a run with {job.sensor_workers} sensor workers"
    return call_in_fresh_process(what, run_sensors, job)
