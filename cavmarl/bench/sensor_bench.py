"""One vehicle with its sensors over some numbers of sensor workers, each run in processes anew."""

from __future__ import annotations

import json
import math
import os
import random
import signal
import statistics
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from cavmarl.bench.core_ceiling import CoreCeiling, measure_ceiling
from cavmarl.bench.sensor_load import Rig, scaled
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

__all__ = ["SensorBench", "Turn", "measure_sensor_workers"]

MAX_WORKERS = 64
PROGRAM = "cavmarl.bench.sensor_run"
TRIES = 8  # to find a load
TRIED_STEPS = 12
MARGIN = 1.15  # above the load that was asked for
TOO_MUCH = 1.5
CEILING_STEPS, CEILING_TURNS = 10, 7

Say = Callable[[str], None]


@dataclass(frozen=True)
class Turn:
    """One run: which it was, and what it found.

    Attributes:
        repeat: from 1.
        place: in the order in which all were run, from 1.
        workers: sensor workers.
        run: what was found.
    """

    repeat: int
    place: int
    workers: int
    run: SensorRun


@dataclass(frozen=True)
class SensorBench:
    """Result of `measure_sensor_workers`.

    Attributes:
        env: of which environment.
        agents: vehicles with sensors.
        background: vehicles without.
        warmup: steps that did not count.
        steps: of each run that did.
        seed: of every run, and of their order.
        placement: who sensed what: by `cost` or `in_turn`.
        load_ms: of sensing, a tick, that was asked for; None: the rig as it is.
        turns: all runs, in their order.
        ceiling: how much faster programs that share nothing do the same sensing side by side, as
            many as the most workers for which there are cores; None: only one.
    """

    env: str
    agents: int
    background: int
    warmup: int
    steps: int
    seed: int
    placement: str
    load_ms: float | None
    turns: tuple[Turn, ...]
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

        As if all lines of a frame cost the same: who divides frames finds out which cost more.
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
        shares = {
            workers: {name: asdict(found) for name, found in self.shares(workers).items()}
            for workers in self.numbers
        }
        return {
            **asdict(self),
            "rows": [row.to_dict() for row in self.rows],
            "ceiling": None if self.ceiling is None else self.ceiling.to_dict(),
            "sd": "sd_within_run is the sample standard deviation (n - 1) of steps within a run",
            "parts_ms": {workers: self.parts_ms(workers) for workers in self.numbers},
            "sensing_ms": self.sensing_ms,
            "costs_ms": self.costs_ms,
            "shares": shares,
            "is_same": self.is_same,
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
    load_ms: float | None = None,
    overrides: Mapping[str, Any] | None = None,
    say: Say = lambda text: None,
) -> SensorBench:
    """Run the same world with each number of sensor workers, in a random order.

    Every run has processes of its own, which share nothing with those of another but files.

    Args:
        env: as in `make_vec`.
        rig: sensors of each agent, by name.
        workers: numbers of sensor workers.
        warmup: steps that do not count.
        steps: of each run that do.
        repeats: runs of each number.
        agents: vehicles with sensors.
        background: vehicles without.
        seed: root of all random numbers of every run, and of their order.
        load_ms: resolutions and rates are raised until the sensors take so long a tick, all of them
            in each; a step is one tick then. None: the rig as it is.
        overrides: values for any other key.
        say: told what is being done.

    Raises:
        ConfigError: numbers that cannot be, or a load that cannot be reached.
        EvaluationError: a run that was not brought to its end.
    """
    _check(workers, warmup, steps, repeats, load_ms)
    given = {"horizon_s": _horizon_s(warmup + steps), **(overrides or {}), "rig": rig}
    job = SensorJob(str(env), given, agents, background, 1, warmup, steps, seed)
    if load_ms is not None:
        job = _loaded(job, load_ms, say)
    config = _config(job)
    order = [(repeat, number) for repeat in range(1, repeats + 1) for number in workers]
    random.Random(seed).shuffle(order)
    turns = []
    for place, (repeat, number) in enumerate(order, 1):
        say(f"run {place} of {len(order)}: {number} sensor workers")
        run = _run(replace(job, sensor_workers=number))
        turns.append(Turn(repeat, place, number, run))
    return SensorBench(
        env=str(env),
        agents=agents,
        background=background,
        warmup=warmup,
        steps=steps,
        seed=seed,
        placement=config.workers.sensor_placement,
        load_ms=load_ms,
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
        agents=job.agents,
        background=job.background,
        overrides=job.overrides,
        alike=True,
    )


def _check(
    workers: Sequence[int], warmup: int, steps: int, repeats: int, load_ms: float | None
) -> None:
    if not workers or len(set(workers)) < len(workers) or not 1 <= min(workers) <= max(workers):
        raise ConfigError(f"workers {list(workers)}: must be numbers from 1, each once")
    if max(workers) > MAX_WORKERS:
        raise ConfigError(f"workers {list(workers)}: at most {MAX_WORKERS}")
    if warmup < 0 or steps < 2 or repeats < 1:
        raise ConfigError(
            f"{warmup} steps of warm-up, {steps} steps, {repeats} repeats: must be at least 0, 2 "
            "and 1"
        )
    if load_ms is not None and not 0.0 < load_ms <= 1e4:
        raise ConfigError(f"load {load_ms:g} ms: must be above 0 and at most 10000")


def _horizon_s(steps: int) -> float:
    """Long enough that no episode ends, whatever a step is."""
    return float(10 * (steps + 1))


def _config(job: SensorJob) -> EnvConfig:
    config, _ = load_config(
        job.env, agents=job.agents, background=job.background, overrides=job.overrides
    )
    return config


def _loaded(job: SensorJob, load_ms: float, say: Say) -> SensorJob:
    """The job with resolutions at which the sensors take so long a tick.

    Those that can have any resolution take about as long as each other. What they take does not
    grow in proportion to their resolutions, so once one rig is too light and another too heavy, the
    next one lies between them.

    Raises:
        ConfigError: they do not.
    """
    even, found_ms = _evened(job, load_ms, say), 0.0
    scale, light, heavy = 1.0, 0.0, math.inf
    for _ in range(TRIES):
        tried = _scaled_by(even, dict.fromkeys(even.overrides["rig"], scale))
        found_ms, _ = _tried(tried, load_ms, say)
        if load_ms <= found_ms <= TOO_MUCH * load_ms:
            return tried
        if found_ms < load_ms:
            light = scale
        else:
            heavy = scale
        between = 0.0 < light and heavy < math.inf
        scale = math.sqrt(light * heavy) if between else scale * MARGIN * load_ms / found_ms
    raise ConfigError(
        f"load {load_ms:g} ms a tick: after {TRIES} tries this rig takes {found_ms:.1f} ms; use "
        "more agents or other sensors, or nothing else on this machine"
    )


def _evened(job: SensorJob, load_ms: float, say: Say) -> SensorJob:
    """The job with each sensor due in every tick, and taking about its share of a load."""
    dt_s = _config(job).clock.sim_dt_s
    even = replace(job, overrides={**job.overrides, "clock.ctrl_dt_s": dt_s})
    factors = dict.fromkeys(job.overrides["rig"], 1.0)
    share_ms = load_ms / len(factors)
    for grown in (False, True):  # what a sensor takes at a low resolution says little
        even = _scaled_by(even, factors)
        found_ms, costs_ms = _tried(even, load_ms, say)
        if grown:  # some cannot take their share: the others get what is left of it
            share_ms *= MARGIN * load_ms / found_ms
        for name, cost_ms in zip(factors, costs_ms, strict=True):
            factors[name] = share_ms / (cost_ms * job.agents) if cost_ms else 1.0
    return _scaled_by(even, factors)


def _scaled_by(job: SensorJob, factors: Mapping[str, float]) -> SensorJob:
    config = _config(job)
    rig = scaled(config, factors, 1.0 / config.clock.sim_dt_s)
    return replace(job, overrides={**job.overrides, "rig": rig})


def _tried(job: SensorJob, load_ms: float, say: Say) -> tuple[float, Sequence[float]]:
    """What all sensors take a tick, in ms, and each of them."""
    tried = _run(replace(job, warmup=TRIED_STEPS, steps=TRIED_STEPS))
    found_ms = statistics.median(tried.parts_ms["sensor compute"])
    say(f"looking for a load of {load_ms:g} ms: it was {found_ms:.3g} ms")
    return found_ms, tried.costs_ms


def _run(job: SensorJob) -> SensorRun:
    """A run in a group of processes of its own.

    Raises:
        CavmarlError: what it raises there.
        EvaluationError: its process died.
    """
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
