"""Draw figures of the two papers from our own measurements; see docs/explanation/papers.md.

`python -m docs.pictures.paper_figures docs/images` draws `drift.svg` again in a minute. `python -m
benchmarks sensors --plot` draws the plot of the sensor workers.
"""

from __future__ import annotations

import sys
from pathlib import Path

from benchmarks.clock_drift import ClockDrift, measure_drift
from cavmarl.core.errors import require

STEPS, ROGUE = 5000, 0.92
# Drift in s of the published Table II before the fix, by steps; it is 0 after the fix.
PUBLISHED = {100: 4.6, 500: 23.0, 1000: 46.0, 5000: 230.0}


def write_drift(path: Path) -> Path:
    """Draw the lead of a follower's clock: with own ticks, without them, and as published."""
    before = measure_drift("ring", steps=STEPS, rogue=ROGUE, answer="obey")
    after = measure_drift("ring", steps=STEPS)
    pyplot = require("matplotlib.pyplot", "report")
    figure, axes = pyplot.subplots(figsize=(7.0, 3.4), layout="constrained")
    axes.plot(*_line(before), "o-", color="#c2410c", label="before: it ticks by itself as well")
    axes.plot(*_line(after), "o-", color="#0b5cad", label="after: it goes by the master's clock")
    steps, deltas = list(PUBLISHED), list(PUBLISHED.values())
    axes.plot(steps, deltas, "x", color="#1f2937", markersize=9, label="published, before")
    axes.set_xlabel("step of 0.05 s")
    axes.set_ylabel("ahead of the master, s")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, metadata={"Date": None})
    pyplot.close(figure)
    return path


def _line(found: ClockDrift) -> tuple[list[int], list[float]]:
    return [row.step for row in found.rows], [row.delta_s for row in found.rows]


if __name__ == "__main__":
    print(write_drift(Path(sys.argv[1]) / "drift.svg"))
