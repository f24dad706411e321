"""The value of messages: drivers trained with and without messages on the blind junction.

    python train/messages.py

The program trains two arms with each seed, as `five_seeds.py` does: `on` with all messages and
`off` without messages (`v2x.channel.loss=1`, so that observations keep their shape). Both arms
drive the same episodes; `on` also drives with increasing loss of messages. The folder gets
`table.md`, `result.json`, `loss.svg` and the runs. All intervals are 95 % by Student's t over the
training seeds, clipped to 0 and 100 % for shares; the arms are paired by seed.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from five_seeds import GOES_ON, Args, Row, interval_of, parse_args, train
from numpy.typing import NDArray

from cavmarl.core.errors import require
from cavmarl.evaluate import evaluate
from cavmarl.evaluate.statistics import Interval
from cavmarl.learning.options import run_to_end

LOSS = "v2x.channel.loss"
LOSSES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
METRICS = {
    "collision": ("collision, % of trips", 100.0),
    "success": ("success, % of trips", 100.0),
    "delay_s": ("delay of arrivals, s", 1.0),
}
Figures = Mapping[str, NDArray[np.float64]]  # metric: (seeds,)


def drive(args: Args, folders: Mapping[int, Path], loss: float, out: Path) -> Figures:
    """Drive an arm's drivers with a loss of messages; return the results by metric."""
    drivers = {folder.name: folder for folder in folders.values()}
    report = evaluate(
        args.env,
        drivers,
        episodes=args.episodes,
        repeats=args.repeats,
        out=out,
        seed=args.evaluation_seed,
        overrides={LOSS: loss},
    )
    return {
        name: np.array([report[driver][name].mean for driver in drivers], dtype=np.float64) * scale
        for name, (_, scale) in METRICS.items()
    }


def row(values: NDArray[np.float64], percent: bool = False) -> Row:
    """Return mean and interval of values (S,), one per seed; `percent` clips to 0 and 100."""
    found = interval_of(values / 100.0 if percent else values, percent)
    if found and percent:
        found = Interval(100.0 * found.low, 100.0 * found.high)
    return Row(float(values.mean()), found, values.tolist())


def table(arms: Mapping[str, Figures], args: Args) -> str:
    """Format the result as Markdown."""
    lines = [
        f"`{args.env}`: {len(args.seeds)} training seeds per arm; {args.repeats} runs of "
        f"{args.episodes} episodes.",
        "",
        "| | " + " | ".join(title for title, _ in METRICS.values()) + " |",
        "| --- |" + " ---: |" * len(METRICS),
    ]
    for name, figures in arms.items():
        rows = [row(figures[key], scale == 100.0) for key, (_, scale) in METRICS.items()]
        lines.append(f"| {name} | " + " | ".join(map(_cell, rows)) + " |")
    apart = {key: arms["on"][key] - arms["off"][key] for key in METRICS}
    lines.append("| on minus off | " + " | ".join(_cell(row(apart[key])) for key in METRICS) + " |")
    return "\n".join(lines) + "\n"


def _cell(found: Row) -> str:
    if found.mean is None or np.isnan(found.mean):  # no vehicle arrived
        return "-"
    interval = "" if found.interval is None else _ends(found.interval)
    return f"{found.mean:.2f}{interval}"


def _ends(interval: Interval) -> str:
    return f" [{interval.low:.2f}, {interval.high:.2f}]"


def draw(path: Path, curve: Mapping[float, Figures], off: Figures) -> None:
    """Plot collisions and delay over the loss of messages, with the mean without messages."""
    require("matplotlib", "report")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    axes = figure.subplots(1, 2)
    for axis, key in zip(axes, ("collision", "delay_s"), strict=True):
        seeds = np.array([figures[key] for figures in curve.values()])  # (losses, seeds)
        shares = [100.0 * loss for loss in curve]
        axis.plot(shares, seeds, color="C0", linewidth=0.6, alpha=0.5)
        axis.plot(shares, seeds.mean(1), color="C0", label="with messages")
        axis.axhline(off[key].mean(), color="C1", label="without")
        axis.set(xlabel="messages lost, %", ylabel=METRICS[key][0], ylim=(0.0, None))
        axis.grid(color="0.9")
    axes[0].legend(frameon=False)
    figure.savefig(path)


def compare(args: Args) -> str:
    """Train both arms, evaluate, and write the results; return the table."""
    arms = {"on": 0.0, "off": 1.0}
    given = [args.settings] if args.settings else []
    folders = {
        arm: train(replace(args, out=args.out / arm, settings=",".join([*given, f"{LOSS}={loss}"])))
        for arm, loss in arms.items()
    }
    room = args.out / "evaluation"
    off = drive(args, folders["off"], arms["off"], room / "off")
    curve = {loss: drive(args, folders["on"], loss, room / f"on_{loss:g}") for loss in LOSSES}
    named = {"on": curve[0.0], "off": off}
    named |= {f"on, {loss:.0%} lost": figures for loss, figures in curve.items() if loss}
    text = table(named, args)
    (args.out / "table.md").write_text(text, encoding="utf-8")
    plain = {
        arm: {key: [None if np.isnan(v) else v for v in of.tolist()] for key, of in one.items()}
        for arm, one in named.items()
    }
    (args.out / "result.json").write_text(json.dumps(plain, indent=2) + "\n", encoding="utf-8")
    draw(args.out / "loss.svg", curve, off)
    return text


def main(words: Sequence[str] | None = None) -> int:
    """Train, evaluate and write; return 0: done, 2: wrong usage, 130: interrupted."""
    given = list(sys.argv[1:] if words is None else words)
    if "--config" not in given:
        given += ["--config", str(Path(__file__).parents[1] / "configs/train/blind_junction.yaml")]

    def run() -> None:
        (args,) = parse_args(given)
        print(compare(args))

    return run_to_end(run, GOES_ON)


if __name__ == "__main__":
    sys.exit(main())
