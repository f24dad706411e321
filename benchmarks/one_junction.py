"""One junction of each kind with turning traffic, compared with SUMO.

A random net mixes kinds of junctions and turns. Here, each net has a single junction with four
single-lane arms, and both sides have the same trips, so that a deviation has one cause.
"""

from __future__ import annotations

import random
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, numbers_of, silent
from cavmarl.cli.output import about
from cavmarl.core.errors import ConfigError, require
from cavmarl.evaluate.traffic.traffic_comparison import compare_traffic

# Kind of junction → its flows: vehicles per hour and arm that go straight on, left and right.
FLOWS: dict[str, tuple[tuple[int, int, int], ...]] = {
    "traffic_light": ((900, 0, 0), (0, 300, 0), (0, 0, 600), (300, 150, 0), (300, 0, 150)),
    "priority": ((150, 60, 60), (80, 30, 30)),
    "right_before_left": ((150, 60, 60), (80, 30, 30)),
    "priority_stop": ((150, 60, 60), (80, 30, 30)),
    "allway_stop": ((250, 100, 100), (150, 60, 60)),
}
ARM_M = 400
ARMS = ("top", "right", "bottom", "left")  # clockwise, so that the opposite arm has the index + 2
TURNS = (2, 1, 3)  # offset of the arm for straight on, left and right


def measure(
    kinds: Annotated[str, about("Comma-separated kinds of junction.")] = ",".join(FLOWS),
    seeds: Annotated[str, about("Comma-separated seeds of the trips, cavmarl and SUMO.")] = "1,2,3",
    seconds: Annotated[int, about("Simulated seconds per run.")] = 900,
    say: Say = silent,
) -> BenchmarkReport:
    """Compare arrivals, delay and speed at one junction with SUMO, summed over several seeds."""
    check_range(seconds=(seconds, 1, 100_000))
    chosen = numbers_of("--seeds", seeds)
    unknown = sorted(set(kinds.split(",")) - set(FLOWS))
    if unknown:
        raise ConfigError(f"--kinds: unknown {', '.join(unknown)}; known: {', '.join(FLOWS)}")
    rows: list[dict[str, Any]] = []
    with TemporaryDirectory() as name:
        for kind in kinds.split(","):
            net = _draw(kind, Path(name))
            for flow in FLOWS[kind]:
                say(f"{kind}, {flow}")
                rows.append({"kind": kind} | _row(net, flow, chosen, seconds))
    columns = {head: head for head in rows[0]}
    return BenchmarkReport(f"cavmarl (SUMO), {seconds} s, seeds {seeds}", columns, rows)


def _draw(kind: str, folder: Path) -> Path:
    net = folder / f"{kind}.net.xml"
    tool = Path(require("sumo", "sumo").SUMO_HOME) / "bin" / "netgenerate"
    words = f"--grid --grid.number 1 --grid.attach-length {ARM_M} --no-turnarounds --seed 1"
    words += f" --random-priority --default-junction-type {kind} -o {net}"
    subprocess.run([tool, *words.split()], check=True, capture_output=True)
    return net


def _trips(path: Path, flow: tuple[int, int, int], seed: int, seconds: int) -> Path:
    """Write cars that arrive at random, with exponential gaps, from each arm."""
    chance = random.Random(seed)
    trips = []
    for per_h, turn in zip(flow, TURNS, strict=True):
        for place, arm in enumerate(ARMS):
            due_s = 0.0
            while per_h and (due_s := due_s + chance.expovariate(per_h / 3600.0)) < seconds:
                trips.append((due_s, arm, ARMS[(place + turn) % len(ARMS)]))
    lines = ['<routes><vType id="car" vClass="passenger"/>']
    for number, (due_s, source, goal) in enumerate(sorted(trips)):
        way = f'from="{source}0A0" to="A0{goal}0"'
        lines.append(f'<trip id="{number}" type="car" depart="{due_s:.1f}" departLane="best"')
        lines.append(f'  departSpeed="max" {way}/>')
    path.write_text("\n".join([*lines, "</routes>"]), encoding="utf-8")
    return path


def _row(
    net: Path, flow: tuple[int, int, int], seeds: list[int], seconds: int
) -> dict[str, str | float]:
    found = []
    for seed in seeds:
        trips = _trips(net.with_name("trips.rou.xml"), flow, seed, seconds)
        found.append(compare_traffic(net, [trips], seconds=seconds, seed=seed))
    ours, sumo = [one.ours.figures for one in found], [one.sumo.figures for one in found]
    arrived, expected = (sum(side.arrived for side in both) for both in (ours, sumo))
    delay_s, usual_s = (
        sum((side.mean_delay_s or 0.0) * side.arrived for side in both) / max(count, 1)
        for both, count in ((ours, arrived), (sumo, expected))
    )
    return {
        "straight, left, right, veh/h": ", ".join(map(str, flow)),
        "arrived": f"{arrived:,} ({expected:,})",
        "arrived, ratio": f"{arrived / max(expected, 1):.3f}",
        "mean delay, s": f"{delay_s:.1f} ({usual_s:.1f})",
        "contacts": f"{sum(side.contacts for side in ours)} ({sum(s.contacts for s in sumo)})",
    }


if __name__ == "__main__":
    run(measure)
