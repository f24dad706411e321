"""The fundamental diagram: flow and speed over density, in cavmarl and in SUMO."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, require
from cavmarl.evaluate.traffic.traffic_comparison import TrafficComparison

LEAST_EDGE_M = 50.0  # on a shorter edge, one vehicle gives a density like that of a jam
BIN_PER_KM = 10.0  # width of the bins whose means a line joins
LEAST_IN_BIN = 5
COLORS = {"SUMO": "#d1793b", "cavmarl": "#2f6db5"}


def plot_fundamental_diagram(found: TrafficComparison, path: Path) -> None:
    """Plot flow and speed over density; a point is a minute of an edge of 50 m or more."""
    figure = require("matplotlib.figure", "report").Figure(
        figsize=(10.0, 4.2), layout="constrained"
    )
    flow, speed = figure.subplots(1, 2)
    for name, run in (("SUMO", found.sumo), ("cavmarl", found.ours)):
        points = run.edge_minutes[run.edge_minutes["length_m"] >= LEAST_EDGE_M]
        density = points["density_per_km"]
        for axes, values in (
            (flow, points["flow_per_h"]),
            (speed, points["speed_mps"]),
        ):
            color = COLORS[name]
            axes.scatter(density, values, s=7.0, alpha=0.45, linewidths=0.0, color=color)
            axes.plot(*binned_means(density, values), color=color, linewidth=2.0, label=name)
    for axes, label in ((flow, "flow, vehicles/h and lane"), (speed, "speed, m/s")):
        axes.set_xlabel("density, vehicles/km and lane")
        axes.set_ylabel(label)
        axes.set_xlim(left=0.0)
        axes.set_ylim(bottom=0.0)
        axes.legend(frameon=False)
    edges = f"each edge of {LEAST_EDGE_M:g} m or more, each minute"
    figure.suptitle(f"{found.map_name}, {found.seconds} s, step {found.dt_s:g} s: {edges}")
    save_figure(figure, path)


def save_figure(figure: Any, path: Path) -> None:
    try:
        figure.savefig(path, dpi=150)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--plot {path}: cannot be written ({error})") from error


def binned_means(
    density: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean density and mean value of each bin with enough points, by density."""
    bins = (density / BIN_PER_KM).astype(np.int64)
    counts = np.bincount(bins)
    enough = counts >= LEAST_IN_BIN
    means = [np.bincount(bins, sums)[enough] / counts[enough] for sums in (density, values)]
    return means[0], means[1]
