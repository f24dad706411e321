"""Plots of a report as SVG text, drawn by matplotlib (extra `report`)."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cavmarl.evaluate.metrics import METRICS, Metric, metric_values
from cavmarl.evaluate.report import EvaluationReport

Rows = NDArray[np.void]

INK, MUTED, RULE, ROAD = "#1f2933", "#616e7c", "#d9dee5", "#cfd5dd"
POLICIES = ("#2563eb", "#d97706", "#0f9d76", "#b4236f", "#7c3aed", "#0e7490")
OUTCOMES = {
    "arrived": ("arrived", "#0f9d76"),
    "unfinished": ("cut by the horizon", "#c3cad4"),
    "collision": ("collision", "#d0342c"),
    "off_road": ("off the road", "#e59a2f"),
}
SHOWN = (
    "episode_return",
    "success",
    "collision",
    "agent_arrivals_per_h",
    "delay_s",
    "mean_speed_mps",
    "mean_jerk_mps3",
    "short_ttc_share",
)
DISTRIBUTIONS = ("delay_s", "least_ttc_s", "least_pet_s", "mean_speed_mps")
COLUMNS = 4
WIDTH_IN = 11.0
MAX_JUMP_M = 40.0  # longest gap between points of a track; a longer one: the agent's next vehicle
MAX_RATIO = 5.0  # largest aspect ratio of a map's picture

STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "cavmarl",
    "font.family": "sans-serif",
    "font.sans-serif": ["Inter", "Helvetica Neue", "Arial", "DejaVu Sans"],
    "font.size": 9.0,
    "text.color": INK,
    "axes.edgecolor": RULE,
    "axes.labelcolor": MUTED,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#eceff3",
    "xtick.color": MUTED,
    "ytick.color": INK,
    "ytick.left": False,
    "legend.frameon": False,
}


def color_of(position: int) -> str:
    """Return the colour of a policy by its position in a report."""
    return POLICIES[position % len(POLICIES)]


def plot_outcomes(report: EvaluationReport) -> str:
    """Plot how trips ended: one bar per policy, mean of the runs."""
    with mpl.rc_context(STYLE):
        names = list(report.policies)
        figure, axes = _figure(0.9 + 0.36 * len(names))
        left = np.zeros(len(names))
        for key, (label, color) in OUTCOMES.items():
            shares = np.array([100.0 * (report[name][key].mean or 0.0) for name in names])
            axes.barh(names, shares, left=left, color=color, height=0.62, label=label)
            for row, (start, share) in enumerate(zip(left, shares, strict=True)):
                if share >= 6.0:
                    ink = INK if key == "unfinished" else "white"
                    where = start + share / 2.0
                    axes.text(where, row, f"{share:.1f}", color=ink, ha="center", va="center")
            left += shares
        axes.set(xlim=(0.0, 100.0), xlabel="% of the trips")
        axes.invert_yaxis()
        axes.grid(visible=False)
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(OUTCOMES))
        return _svg(figure)


def plot_metrics(report: EvaluationReport) -> str:
    """Plot mean and interval of the main metrics, with a point per run."""
    metrics = [metric for metric in METRICS if metric.name in SHOWN]
    rows = -(-len(metrics) // COLUMNS)
    with mpl.rc_context(STYLE):
        figure = Figure(
            figsize=(WIDTH_IN, rows * (0.95 + 0.3 * len(report.policies))), layout="constrained"
        )
        panels = figure.subplots(rows, COLUMNS, sharey=True, squeeze=False)
        for axes, metric in zip(panels.flat, metrics, strict=True):
            _plot_metric(axes, metric, report)
        panels[0, 0].set_yticks(range(len(report.policies)), list(report.policies))
        panels[0, 0].set_ylim(len(report.policies) - 0.4, -0.6)
        return _svg(figure)


def _plot_metric(axes: Axes, metric: Metric, report: EvaluationReport) -> None:
    axes.set_title(metric.title)
    axes.grid(visible=False, axis="y")
    for row, policy in enumerate(report.policies.values()):
        found, color = policy[metric.name], color_of(row)
        if found.mean is None:
            continue
        runs = [metric.scale * run.mean for run in found.within_run if run.mean is not None]
        if report.repeats > 1:
            below = [row + 0.25] * len(runs)
            axes.plot(runs, below, "o", color=color, alpha=0.45, markersize=3.5, mew=0)
        if found.interval is not None:
            ends = [metric.scale * found.interval.low, metric.scale * found.interval.high]
            axes.plot(ends, [row, row], color=color, linewidth=2.2, solid_capstyle="butt")
        axes.plot(metric.scale * found.mean, row, "o", color=color, markersize=6.0)


def plot_distributions(tables: Mapping[str, tuple[Rows, Rows]]) -> str:
    """Plot the distribution of trips over all runs: share below each value."""
    spreads = {metric: _sorted_values(metric, tables) for metric in METRICS}
    drawn = [m for m in METRICS if m.name in DISTRIBUTIONS and any(v.size for v in spreads[m])]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 2.5), layout="constrained")
        panels = figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0]
        for axes, metric in zip(panels, drawn, strict=True):
            for row, (policy, values) in enumerate(zip(tables, spreads[metric], strict=True)):
                shares = 100.0 * np.arange(1, values.size + 1) / max(values.size, 1)
                axes.step(
                    values, shares, where="post", color=color_of(row), linewidth=1.6, label=policy
                )
            axes.set(title=metric.title, ylim=(0.0, 101.0))
        panels[0].set_ylabel("% of the trips at or below")
        lines, names = panels[0].get_legend_handles_labels()
        figure.legend(lines, names, loc="outside upper right", ncols=len(tables))
        return _svg(figure)


def _sorted_values(
    metric: Metric, tables: Mapping[str, tuple[Rows, Rows]]
) -> list[NDArray[np.float64]]:
    values = [metric_values(metric, trips, episodes) for trips, episodes in tables.values()]
    return [np.sort(one[~np.isnan(one)]) for one in values]


def plot_map(outline: Mapping[str, Any], tracks: Rows, trips: Rows, color: str) -> str:
    """Plot the roads, the tracks of one episode, and the places of failed trips of all runs."""
    min_x, min_y, max_x, max_y = outline["extent_m"]
    width, height = max(max_x - min_x, 1.0), max(max_y - min_y, 1.0)
    true_to_scale = 1.0 / MAX_RATIO < height / width < MAX_RATIO
    tall = WIDTH_IN * min(max(height / width, 0.2), 0.75)
    with mpl.rc_context(STYLE):
        figure, axes = _figure(tall)
        points_a_metre = 72.0 * min(WIDTH_IN / width, tall / height)
        thick = max(0.6, outline["lane_width_m"] * points_a_metre) if true_to_scale else 4.0
        lines = [np.array(line) for line in outline["lines"]]
        axes.add_collection(LineCollection(lines, colors=ROAD, linewidths=thick, zorder=1))
        ways = LineCollection(_ways(tracks), colors=color, linewidths=1.3, alpha=0.55, zorder=2)
        axes.add_collection(ways)
        for key, mark in (("off_road", "^"), ("collision", "X")):
            label, ink = OUTCOMES[key]
            bad = trips[trips[key]]
            axes.scatter(
                bad["end_x_m"],
                bad["end_y_m"],
                s=26.0,
                marker=mark,
                color=ink,
                edgecolors="white",
                linewidths=0.5,
                zorder=3,
                label=f"{label} ({bad.size})",
            )
        margin = 0.02 * max(width, height)
        across = margin if true_to_scale else 0.1 * min(width, height)
        axes.set_xlim(
            min_x - (margin if true_to_scale or width > height else across), max_x + margin
        )
        axes.set_ylim(min_y - across, max_y + across)
        if true_to_scale:
            axes.set_aspect("equal")
        axes.set(xlabel="x, m", ylabel="y, m" if true_to_scale else "y, m (not to scale)")
        axes.grid(visible=False)
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
        return _svg(figure)


def _ways(tracks: Rows) -> list[NDArray[np.float64]]:
    """Return the tracks (n, 2) of the agents, split where an agent got a new vehicle."""
    rows = tracks[np.lexsort((tracks["time_s"], tracks["agent"]))]
    places = np.stack([rows["x_m"], rows["y_m"]], axis=1)
    jumps = np.hypot(*np.diff(places, axis=0).T) > MAX_JUMP_M
    cuts = np.flatnonzero(jumps | (np.diff(rows["agent"]) != 0)) + 1
    return [way for way in np.split(places, cuts) if len(way) > 1]


def plot_learning(rows: Sequence[Mapping[str, str]]) -> str:
    """Plot a training: success and collisions of the last trips, by decisions.

    `rows`: rows of its file progress.csv.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 2.6), layout="constrained")
        decisions = [float(row["agent_steps"]) / 1e6 for row in rows]
        for axes, (name, outcome) in zip(
            figure.subplots(1, 2), (("success", "arrived"), ("collision", "collision")), strict=True
        ):
            shares = [100.0 * float(row[name]) for row in rows]
            axes.plot(decisions, shares, color=OUTCOMES[outcome][1])
            axes.set_title(f"{name}, % of the last 1,000 trips")
            axes.set_xlabel("million decisions")
        return _svg(figure)


def plot_series(series: Mapping[str, Sequence[float]], shown: Sequence[str], label: str) -> str:
    """Plot the columns `shown` of a table over its column `time_s`, in one figure."""
    with mpl.rc_context(STYLE):
        figure, axes = _figure(2.8)
        for place, name in enumerate(shown):
            axes.plot(series["time_s"], series[name], color=color_of(place), label=name)
        axes.set(xlabel="time, s", ylabel=label)
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(shown))
        return _svg(figure)


def plot_roads(
    lines: Sequence[NDArray[np.float64]], marked: Mapping[str, Sequence[NDArray[np.float64]]]
) -> str:
    """Plot roads to scale; draw some roads in colours with a legend.

    `lines`: (n, 2) each, in m. `marked`: label → lines.
    """
    places = np.concatenate(lines)
    width, height = np.maximum(np.ptp(places, axis=0), 1.0).tolist()
    with mpl.rc_context(STYLE):
        figure, axes = _figure(WIDTH_IN * min(max(height / width, 0.2), 0.75))
        axes.add_collection(LineCollection(lines, colors=ROAD, linewidths=1.2))
        for place, (label, some) in enumerate(marked.items()):
            color = color_of(place)
            axes.add_collection(LineCollection(some, colors=color, linewidths=2.4, label=label))
        axes.autoscale_view()
        axes.set_aspect("equal")
        axes.set(xlabel="x, m", ylabel="y, m")
        axes.grid(visible=False)
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4)
        return _svg(figure)


def _figure(height_in: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    return figure, figure.subplots()


def _svg(figure: Figure) -> str:
    """Return the figure as an <svg> element that can share a page with others."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    # All figures have the same ids of groups, so remove them. Ids that are referenced are hashes.
    return re.sub(r' id="[A-Za-z0-9.]+_\d+"', "", text)
