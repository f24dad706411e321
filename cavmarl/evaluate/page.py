"""Writes a report as a self-contained HTML file: tables, plots, the map, the manifest."""

from __future__ import annotations

import base64
import csv
import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from cavmarl.core.errors import require
from cavmarl.evaluate.evaluation import load_map, load_report, load_tables, load_tracks
from cavmarl.evaluate.metrics import METRICS, Metric
from cavmarl.evaluate.provenance.manifest import write_text
from cavmarl.evaluate.report import EvaluationReport, Found, PairedDifference
from cavmarl.evaluate.statistics import Interval
from cavmarl.ownership.transfer_summary import Spread, TransferSummary

TEMPLATE = Path(__file__).with_name("page.html.j2")
NOTHING = "-"


@dataclass(frozen=True)
class Story:
    """The introduction of a page of results: a training, and pictures of it.

    Attributes:
        title: headline of the page.
        paragraphs: text.
        compared: names of the metrics in a short table.
        curve: the file progress.csv of the training.
        films: caption → animated WebP, which becomes a part of the page.
        commands: (command, purpose) of next steps.
    """

    title: str
    paragraphs: Sequence[str]
    compared: Collection[str]
    curve: Path
    films: Mapping[str, Path]
    commands: Sequence[tuple[str, str]]


def write_page(folder: Path, path: Path, story: Story | None = None) -> None:
    """Write the page of a results folder of `evaluate`; it begins with `story`, if there is one."""
    require("matplotlib", "report")
    jinja2 = require("jinja2", "report")
    report = load_report(folder)
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    told = None if story is None else _told(story, report)
    write_text(path, template.render(_content(folder, report), story=told))


def _told(story: Story, report: EvaluationReport) -> dict[str, Any]:
    """Return the parts of a story for the template."""
    from cavmarl.evaluate import plots

    with story.curve.open(encoding="utf-8", newline="") as file:
        curve = plots.plot_learning(list(csv.DictReader(file)))
    rows = _rows(report, rewards=False)
    return {
        "title": story.title,
        "paragraphs": story.paragraphs,
        "rows": [row for row in rows if row["metric"].name in story.compared],
        "curve": curve,
        "films": {
            caption: base64.b64encode(film.read_bytes()).decode()
            for caption, film in story.films.items()
        },
        "commands": story.commands,
    }


def _content(folder: Path, report: EvaluationReport) -> dict[str, Any]:
    from cavmarl.evaluate import plots

    tables, tracks, outline = load_tables(folder), load_tracks(folder), load_map(folder)
    first, *others = report.policies
    return {
        "report": report,
        "manifest": report.manifest,
        "facts": _facts(report.manifest),
        "manifest_text": json.dumps(report.manifest, indent=2),
        "policies": [(name, plots.color_of(k)) for k, name in enumerate(report.policies)],
        "first": first,
        "others": others,
        "rows": _rows(report, rewards=False),
        "reward_rows": _rows(report, rewards=True),
        "differences": _differences(report, others),
        "runs": _runs(report),
        "transfers": transfer_rows(report),
        "outcomes": plots.plot_outcomes(report),
        "metrics": plots.plot_metrics(report),
        "distributions": plots.plot_distributions(tables),
        "maps": {
            name: plots.plot_map(outline, tracks[name], tables[name][0], plots.color_of(k))
            for k, name in enumerate(report.policies)
        },
    }


def _rows(report: EvaluationReport, *, rewards: bool) -> list[dict[str, Any]]:
    """Return rows of the metrics that have a value; terms of the return need one other than 0."""
    rows = []
    for metric in METRICS:
        found = [policy[metric.name] for policy in report.policies.values()]
        values = [one.mean for one in found]
        if metric.name.startswith("reward_") != rewards or not any(
            value is not None and (value != 0.0 or not rewards) for value in values
        ):
            continue
        rows.append({"metric": metric, "cells": [_cell(metric, one) for one in found]})
    return rows


def _cell(metric: Metric, found: Found) -> dict[str, str]:
    return {
        "mean": _figure(found.mean, metric),
        "interval": _ends(found.interval, metric),
        "sd": NOTHING if metric.share else _figure(found.within_sd, metric),
    }


def _differences(report: EvaluationReport, others: list[str]) -> list[dict[str, Any]]:
    rows = []
    for metric in METRICS:
        found = [report[name].minus_first[metric.name] for name in others]
        if metric.name.startswith("reward_") or all(one.mean is None for one in found):
            continue
        rows.append({"metric": metric, "cells": [_change(metric, one) for one in found]})
    return rows


def _change(metric: Metric, found: PairedDifference) -> dict[str, str]:
    mean = NOTHING if found.mean is None else f"{metric.scale * found.mean:+.2f}"
    return {
        "mean": mean,
        "interval": _ends(found.between_run_ci95, metric),
        "verdict": _verdict(metric, found),
    }


def _verdict(metric: Metric, found: PairedDifference) -> str:
    """Return `better` or `worse`, or an empty text if the difference cannot be judged."""
    if not found.distinct or metric.better is None or found.mean is None:
        return ""
    return "better" if (found.mean > 0.0) == (metric.better == "more") else "worse"


def _runs(report: EvaluationReport) -> list[dict[str, Any]]:
    """Return the figures of each run: one row per policy, metric and run."""
    return [
        {
            "policy": name,
            "metric": metric,
            "run": run,
            "seed": report.seeds[run],
            "n": within.n,
            "mean": _figure(within.mean, metric),
            "sd": _figure(within.sd, metric),
            "wilson": _ends(within.wilson95, metric),
        }
        for name, policy in report.policies.items()
        for metric in METRICS
        for run, within in enumerate(policy[metric.name].within_run)
        if within.n and not metric.name.startswith("reward_")
    ]


def _facts(manifest: Mapping[str, Any]) -> dict[str, str]:
    hardware, software, code, world = (
        manifest[key] for key in ("hardware", "software", "code", "world")
    )
    dirty = {True: ", with changed files", False: "", None: ""}[code["dirty"]]
    packages = (f"{name} {found}" for name, found in software["packages"].items() if found)
    return {
        "command": " ".join(manifest["command"]),
        "started, ended": f"{manifest['started']}, {manifest['ended']}",
        "processor": f"{hardware['cpu']}, {hardware['usable_cores']} of "
        f"{hardware['logical_cores']} cores",
        "memory": f"{hardware['memory_gb']} GB",
        "GPU": ", ".join(hardware["gpus"]) or "none",
        "system": f"{software['os']}, {software['python']}",
        "packages": ", ".join(packages),
        "commit": f"{code['commit']}{dirty}",
        "configuration": f"{world['environment']}, SHA-256 {world['config_sha256']}",
        "map": f"{world['map']}, SHA-256 of its content {world['map_content_sha256']}",
        "demand": f"SHA-256 of its content {world.get('demand_content_sha256') or '- (generated)'}",
        "zones": f"{world.get('zones', 1)}, SHA-256 {world.get('zones_content_sha256') or '-'}",
        "kernels": str(world["kernels"]),
        "seeds of the runs": ", ".join(map(str, manifest["seeds"])),
        "processes": str(manifest["plan"]["processes"]),
        "channel": _channel(world["channel"]),
    }


def _channel(told: str | Mapping[str, Any]) -> str:
    if isinstance(told, str):
        return told
    return ", ".join(f"{key} {value}" for key, value in told.items())


def _figure(value: float | None, metric: Metric) -> str:
    return NOTHING if value is None else f"{metric.scale * value:.2f}"


def _ends(interval: Interval | None, metric: Metric) -> str:
    if interval is None:
        return NOTHING
    return f"{metric.scale * interval.low:.2f} … {metric.scale * interval.high:.2f}"


class _Figure(NamedTuple):
    label: str
    unit: str
    meaning: str
    value: Callable[[TransferSummary], Spread | float | None]


FIGURES = (
    _Figure("changes", "", "vehicles that changed their owner", lambda found: found.transfers),
    _Figure("forced", "", "changes with the state attached, because no answer had come in time",
            lambda found: found.forced),
    _Figure("failure rate", "%", "share of forced changes",
            lambda found: None if found.failure_rate is None else 100.0 * found.failure_rate),
    _Figure("deferred", "ticks",
            "how long vehicles beyond the border stayed with their owners, summed",
            lambda found: found.deferred),
    _Figure("refused", "", "states that a zone has refused", lambda found: found.refused),
    _Figure("withdrawn", "", "approaches that ended without a change",
            lambda found: found.aborted),
    _Figure("left the world", "", "vehicles that left in the tick of their change",
            lambda found: found.removed),
    _Figure("timeouts, acknowledge", "", "cases in which no answer came by the end of a tick",
            lambda found: found.timeouts["acknowledge"]),
    _Figure("timeouts, switch", "", "cases in which no answer came by the deadline",
            lambda found: found.timeouts["switch"]),
    _Figure("timeouts, replica", "",
            "states that were neither used nor withdrawn in their lifetime",
            lambda found: found.timeouts["replica"]),
    _Figure("latency", "ticks", "time from the first state at the new owner to its confirmation",
            lambda found: found.latency_ticks),
    _Figure("latency behind the border", "ticks", "the part of this time after the crossing",
            lambda found: found.waited_ticks),
    _Figure("latency", "ms",
            "wall time from the first state to the confirmation; not repeatable",
            lambda found: found.latency_ms),
    _Figure("state", "bytes", "size of the state of a vehicle", lambda found: found.state_bytes),
    _Figure("depth at PREPARE", "m",
            "distance outside of the old zone at the first state; below 0: inside",
            lambda found: found.prepare_depth_m),
    _Figure("depth at SWITCH", "m", "the same distance when the change was decided",
            lambda found: found.switch_depth_m),
    _Figure("depth at RELEASE", "m", "the same distance when the change was committed",
            lambda found: found.release_depth_m),
)  # fmt: skip


def transfer_rows(report: EvaluationReport) -> list[dict[str, Any]]:
    """Return label, unit, meaning and cells of each figure; nothing for undivided worlds."""
    found = [policy.transfers for policy in report.policies.values()]
    if all(summary is None for summary in found):
        return []
    return [
        {
            "label": figure.label,
            "unit": figure.unit,
            "meaning": figure.meaning,
            "cells": [
                NOTHING if summary is None else _plain(figure.value(summary)) for summary in found
            ],
        }
        for figure in FIGURES
    ]


def _plain(value: Spread | float | None) -> str:
    if isinstance(value, Spread):
        return " / ".join(_plain(part) for part in value)
    if value is None:
        return NOTHING
    return f"{value:,}" if isinstance(value, int) else f"{value:.2f}"
