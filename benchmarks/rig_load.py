"""Create a rig for the benchmark `sensors` that takes a given time per tick.

Every sensor is due in every tick. Resolutions are raised until all sensors together take this time.
Sensors with variable resolution take about equal shares.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any

import yaml

from benchmarks.program import run
from benchmarks.sensor_bench import first_job, job_config, run_job
from benchmarks.sensor_run import Rig, SensorJob, load_rig
from cavmarl.bench.harness import BenchmarkReport, Say, silent
from cavmarl.cli.output import OptionalEnvironment, Seed, Settings, about, parse_settings
from cavmarl.config.env import EnvConfig
from cavmarl.config.registry import find_settings
from cavmarl.config.rig import MAX_SAMPLE_NUMBERS, MountedConfig
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError

TRIES = 8  # attempts to find a load
TRIED_STEPS = 12  # number of warm-up steps, and of measured steps, of an attempt
MARGIN = 1.15  # margin above the requested load
TOO_MUCH = 1.5  # largest accepted time / requested time

# Upper limits of a sensor's settings; see `config/rig.py`.
_LIMITS = {"rays": 8192, "layers": 128, "width": 4096, "height": 4096}
_LEAST_CELL_M = 0.05
_SCALED = {*_LIMITS, "cell_m"}


def measure(
    env: OptionalEnvironment = "town",
    load: Annotated[float, about("Milliseconds of sensing per tick.", metavar="MS")] = 20.0,
    out: Annotated[Path, about("Write the rig to this file.")] = Path("rig.yaml"),
    rig: Annotated[str, about("Rig: a name in configs/rigs/, or a .yaml file.")] = "ten_sensors",
    agents: Annotated[int, about("Number of vehicles with sensors.")] = 1,
    background: Annotated[int, about("Number of vehicles without sensors.")] = 0,
    seed: Seed = 0,
    settings: Settings = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Find resolutions at which a rig takes a given time per tick, and write it to a file."""
    if not 0.0 < load <= 1e4:
        raise ConfigError(f"load {load:g} ms: must be above 0 and at most 10000")
    keys = {"agents": agents, "background": background, "seed": seed}
    spec = WorldSpec(env=env, overrides=parse_settings(settings), **keys)
    job = first_job(spec, load_rig(find_settings("rig", rig)), (TRIED_STEPS, TRIED_STEPS))
    found = loaded(job, load, say)
    try:
        out.write_text(yaml.safe_dump(_plain(found.spec.overrides["rig"])), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"--out {out}: cannot be written ({error.strerror})") from error
    config = job_config(found)
    dt_s = config.clock.sim_dt_s
    rows = [{"name": name, "shape": sensor.shape} for name, sensor in config.rig.items()]
    return BenchmarkReport(
        f"{out}: {load:g} ms per tick",
        {"sensor": "name", "sample": "shape"},
        rows,
        notes=[f"python -m benchmarks sensors {env} --rig {out} --set clock.ctrl_dt_s={dt_s:g}"],
        facts={"load_ms": load, "rig": _plain(found.spec.overrides["rig"])},
    )


def _plain(rig: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: {key: list(v) if isinstance(v, tuple) else v for key, v in sensor.items()}
        for name, sensor in rig.items()
    }


def loaded(job: SensorJob, load_ms: float, say: Say) -> SensorJob:
    """Return the job with resolutions at which the sensors take a given time per tick.

    Sensors with variable resolution take about equal times. Times are not proportional to
    resolutions, so the next attempt lies between a rig that takes too little time and a rig that
    takes too much.
    """
    even, found_ms = _evened(job, load_ms, say), 0.0
    scale, light, heavy = 1.0, 0.0, math.inf
    for _ in range(TRIES):
        tried = _scaled_by(even, dict.fromkeys(even.spec.overrides["rig"], scale))
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
        f"load {load_ms:g} ms per tick: after {TRIES} tries this rig takes {found_ms:.1f} ms; use "
        "more agents or other sensors, or stop other programs"
    )


def _evened(job: SensorJob, load_ms: float, say: Say) -> SensorJob:
    """Return the job in which each sensor is due in every tick and takes an equal share."""
    dt_s = job_config(job).clock.sim_dt_s
    even = _changed(job, {"clock.ctrl_dt_s": dt_s})
    factors = dict.fromkeys(job.spec.overrides["rig"], 1.0)
    share_ms = load_ms / len(factors)
    for grown in (False, True):  # the costs of low resolutions do not scale
        even = _scaled_by(even, factors)
        found_ms, costs_ms = _tried(even, load_ms, say)
        if grown:  # sensors that cannot grow take less than their share; others take the rest
            share_ms *= MARGIN * load_ms / found_ms
        for name, cost_ms in zip(factors, costs_ms, strict=True):
            factors[name] = share_ms / (cost_ms * (job.spec.agents or 1)) if cost_ms else 1.0
    return _scaled_by(even, factors)


def _changed(job: SensorJob, values: Mapping[str, Any]) -> SensorJob:
    return replace(job, spec=replace(job.spec, overrides={**job.spec.overrides, **values}))


def _scaled_by(job: SensorJob, factors: Mapping[str, float]) -> SensorJob:
    config = job_config(job)
    rig = scaled(config, factors, 1.0 / config.clock.sim_dt_s)
    return _changed(job, {"rig": rig})


def _tried(job: SensorJob, load_ms: float, say: Say) -> tuple[float, Sequence[float]]:
    """Return the time of all sensors per tick in ms, and the time of each sensor."""
    tried = run_job(replace(job, warmup=TRIED_STEPS, steps=TRIED_STEPS))
    found_ms = statistics.median(tried.parts_ms["sensor compute"])
    say(f"searching a load of {load_ms:g} ms: found {found_ms:.3g} ms")
    return found_ms, tried.costs_ms


def scaled(config: EnvConfig, factors: Mapping[str, float], rate_hz: float) -> Rig:
    """Return the rig of an environment with more pixels, rays and cells, within their limits.

    Pictures keep their proportions. Sensors without a resolution stay unchanged.
    """
    return {name: _scaled(sensor, factors[name], rate_hz) for name, sensor in config.rig.items()}


def _scaled(sensor: MountedConfig, factor: float, rate_hz: float) -> dict[str, Any]:
    values = {field.name: getattr(sensor, field.name) for field in fields(sensor)}
    if _SCALED & values.keys():
        values |= {"rate_hz": rate_hz, "phase_ticks": 0}
    side = math.sqrt(min(factor, MAX_SAMPLE_NUMBERS / math.prod(sensor.shape)))
    if "cell_m" in values:
        values["cell_m"] = max(values["cell_m"] / side, _LEAST_CELL_M)
    for name in ("width", "height"):
        if name in values:
            values[name] = min(int(values[name] * side), _LIMITS[name])
    for name in ("rays", "layers"):
        if name in values:
            wanted = max(1, min(round(values[name] * factor), _LIMITS[name]))
            factor *= values[name] / wanted  # the rest after rounding
            values[name] = wanted
    return values


if __name__ == "__main__":
    run(measure)
