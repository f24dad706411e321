"""The figure of sensor workers: FPS and the time of a step over how many there are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cavmarl.bench.sensor_scaling import ScalingRow
from cavmarl.core.errors import ConfigError, require

FPS, STEP = "#2f6db5", "#d1793b"
HEADROOM = 1.1  # over the largest value


def plot_sensor_workers(rows: Sequence[ScalingRow], title: str, path: Path) -> None:
    """Write both over the number of sensor workers; the best is marked."""
    figure = require("matplotlib.figure", "report").Figure(figsize=(7.0, 4.2), layout="constrained")
    left = figure.subplots()
    right = left.twinx()
    numbers = [row.workers for row in rows]
    left.plot(numbers, [row.fps for row in rows], "o-", color=FPS)
    right.errorbar(
        numbers,
        [row.step_ms for row in rows],
        yerr=[row.sd_within_run for row in rows],
        fmt="s--",
        capsize=3.0,
        color=STEP,
    )
    (best,) = (row for row in rows if row.is_best)
    left.annotate(
        "best", (best.workers, best.fps), (0.0, 8.0), textcoords="offset points", ha="center",
        color=FPS, weight="bold",
    )  # fmt: skip
    for axes, label, color in (
        (left, "frames a second", FPS),
        (right, "tick and sensors, ms (± SD within a run)", STEP),
    ):
        axes.set_ylabel(label, color=color)
        axes.tick_params(axis="y", colors=color)
        axes.set_ylim(0.0, HEADROOM * axes.get_ylim()[1])
    left.set_xlabel("sensor workers")
    left.set_xticks(numbers)
    figure.suptitle(title)
    try:
        figure.savefig(path, dpi=150)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--plot {path}: cannot be written ({error})") from error
