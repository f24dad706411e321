"""Baselines for a map: three drivers in traffic, and the built-in driver on empty roads.

Random actions, the built-in driver and a trained driver drive the same trips on the map, in traffic
and under the rules of the environment `cities`. The built-in driver also drives alone on the map,
on other trips. The difference between its two results estimates the cost of traffic. The result on
empty roads is not a bound: another driver can be better.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from cavmarl.config.registry import load_config, resolve_maps
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import require
from cavmarl.evaluate.episodes import Progress
from cavmarl.evaluate.evaluation import evaluate, load_map, load_tables, load_tracks
from cavmarl.evaluate.metrics import KM_PER_INFRACTION, METRICS, Metric
from cavmarl.evaluate.provenance.manifest import write_text
from cavmarl.evaluate.report import EvaluationReport, PolicyReport
from cavmarl.parallel.placement.backend_name import LOCAL

RULES = "cities"  # the environment whose rules and trained driver are used
GENERALIST = "cities_ippo"
FREE_ROAD = "idm alone"
AMONG, ALONE = "among", "alone"  # subfolders of the results
FIGURES = (
    "success",
    "collision",
    "off_road",
    "red_light",
    "stood",
    "blocked",
    "out_of_time",
    KM_PER_INFRACTION,
    "delay_s",
    "mean_jerk_mps3",
)
_PAGE = Path(__file__).with_name("baseline.html.j2")


def run_baseline(
    where: str,
    out: Path,
    *,
    policy: str = GENERALIST,
    agents: int | None = None,
    background: int | None = None,
    episodes: int = 6,
    seed: int = 0,
    progress: Progress | None = None,
    overrides: Mapping[str, Any] | None = None,
    zones: int | None = None,
    backend: str = LOCAL,
) -> dict[str, EvaluationReport]:
    """Evaluate `random_actions`, `idm` and a trained driver in traffic, and `idm` alone.

    Args:
        where: a map file, or an environment whose maps are used.
        out: folder of the results; it gets the subfolders `among` and `alone`.
        policy: the trained driver.
        agents: number of agents in each world; None: as configured by `cities`.
        background: number of background vehicles; None: as configured by `cities`.
        episodes: episodes of each driver in traffic. `idm` alone drives eight times as many, up to
            64.
        seed: seed of the episodes.
        progress: as in `evaluate`.
        overrides: values of other keys of `cities`.
        zones: as in `evaluate`.
        backend: as in `evaluate`.

    Raises the errors of `evaluate`, for example for a map that cannot be driven.
    """
    config, base_dir = load_config(where)
    maps = [str(path) for path in resolve_maps(config, base_dir)]
    keys = {**(overrides or {}), "map.source": maps[0] if len(maps) == 1 else maps}
    busy = WorldSpec(env=RULES, agents=agents, background=background, seed=seed, overrides=keys)
    empty = WorldSpec(env=RULES, agents=1, background=0, seed=seed, overrides=keys)
    drivers = {Path(name).name: name for name in ("random_actions", "idm", policy)}
    alone = min(64, 8 * episodes)
    run = partial(evaluate, zones=zones, backend=backend, progress=progress)
    return {
        AMONG: run(busy, drivers, episodes=episodes, out=out / AMONG),
        ALONE: run(empty, {FREE_ROAD: "idm"}, episodes=alone, out=out / ALONE),
    }


def baseline_drivers(found: Mapping[str, EvaluationReport]) -> dict[str, PolicyReport]:
    """Return the results of each driver, with `FREE_ROAD` last."""
    return {
        name: driver for part in (AMONG, ALONE) for name, driver in found[part].policies.items()
    }


def figures() -> Sequence[Metric]:
    """Return the metrics of the table, in the order of `FIGURES`."""
    by_name = {metric.name: metric for metric in METRICS}
    return [by_name[name] for name in FIGURES]


def write_baseline(folder: Path, found: Mapping[str, EvaluationReport], path: Path) -> None:
    """Write the results of `run_baseline` as one self-contained page.

    Raises MissingExtraError if matplotlib or Jinja2 is not installed.
    """
    require("matplotlib", "report")
    jinja2 = require("jinja2", "report")
    from cavmarl.evaluate import plots

    among = folder / AMONG
    tables, tracks, outline = load_tables(among), load_tracks(among), load_map(among)
    report = found[AMONG]
    template = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).from_string(_PAGE.read_text(encoding="utf-8"))
    content: dict[str, Any] = {
        "world": report.manifest["world"],
        "episodes": report.episodes,
        "seed": report.seeds[0],
        "trips": {
            name: driver.trips for part in found.values() for name, driver in part.policies.items()
        },
        "metrics": figures(),
        "rows": {name: _texts(driver) for name, driver in baseline_drivers(found).items()},
        "outcomes": plots.plot_outcomes(report),
        "maps": {
            name: plots.plot_map(outline, tracks[name], tables[name][0], plots.color_of(k))
            for k, name in enumerate(report.policies)
        },
    }
    write_text(path, template.render(content))


def _texts(driver: PolicyReport) -> list[tuple[str, str]]:
    """Return mean and interval of each figure as text."""
    texts = []
    for metric in figures():
        one = driver[metric.name]
        above = "> " if driver.is_above(metric) else ""
        mean = "-" if one.mean is None else f"{above}{metric.scale * one.mean:.2f}"
        ends = one.interval and (one.interval.low, one.interval.high)
        spread = " … ".join(f"{metric.scale * end:.1f}" for end in ends) if ends else ""
        texts.append((mean, spread))
    return texts
