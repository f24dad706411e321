"""The table of docs/figures/realism.md: traffic compared with SUMO, over maps and seeds.

Maps outside the eclipse-sumo wheel come from a folder. Demands with missing files are left out and
listed.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, numbers_of, silent
from cavmarl.cli.output import about
from cavmarl.core.errors import require
from cavmarl.evaluate.traffic.traffic_comparison import compare_traffic
from cavmarl.evaluate.traffic.traffic_metrics import TrafficFigures

DEMANDS = {  # (folder, map, demand); MAPS is the folder of maps, GAME the games in the wheel
    "Bologna Acosta": "MAPS/net/bologna_acosta acosta_buslanes.net.xml run.sumocfg",
    "Mcity": "MAPS/net/mcity mcity.net.xml mcity.rou.xml mcity.add.xml",
    "Town10HD, 25 vehicles": "MAPS net/Town10HD.net.xml demand/town10hd_25.rou.xml",
    "Town10HD, 50 vehicles": "MAPS net/Town10HD.net.xml demand/town10hd_50.rou.xml",
    "kuehne": "GAME/kuehne kuehne.net.xml kuehne.rou.xml",
    "cross_demo": "GAME cross/cross.net.xml cross_demo.sumocfg",
    "ramp": "GAME/ramp ramp.net.xml ramp.rou.xml",
}
COLUMNS: dict[str, tuple[str, str]] = {  # head of a column: (figure, format)
    "arrived": ("arrived", ",.0f"),
    "mean speed, m/s": ("mean_speed_mps", ".2f"),
    "mean delay, s": ("mean_delay_s", ".0f"),
    "queue at signals": ("queue", ".1f"),
    "contacts": ("contacts", ",.0f"),
    "longest lock, s": ("longest_lock_s", ".0f"),
}


def measure(
    maps: Annotated[Path, about("Folder of the maps outside the wheel.")] = Path("maps"),
    seeds: Annotated[str, about("Comma-separated seeds of cavmarl and SUMO.")] = "1,2,3",
    seconds: Annotated[int, about("Simulated seconds per run.")] = 900,
    say: Say = silent,
) -> BenchmarkReport:
    """Compare with SUMO over several seeds; show the range of each figure."""
    check_range(seconds=(seconds, 1, 100_000))
    chosen = numbers_of("--seeds", seeds)
    game = Path(require("sumo", "sumo").SUMO_HOME) / "tools" / "game"
    rows: list[dict[str, Any]] = []
    notes = []
    for name, words in DEMANDS.items():
        folder, *files = words.replace("MAPS", str(maps)).replace("GAME", str(game)).split()
        network, *demand = (Path(folder, file) for file in files)
        if not network.exists():
            notes.append(f"{name} is left out: no {network}; set the folder with --maps")
            continue
        found = []
        for seed in chosen:
            say(f"{name}, seed {seed}")
            found.append(compare_traffic(network, demand, seconds=seconds, seed=seed))
        ours, sumo = [one.ours.figures for one in found], [one.sumo.figures for one in found]
        shown = {head: _both(ours, sumo, *figure) for head, figure in COLUMNS.items()}
        rows.append({"demand": name, **shown})
    columns = {"demand": "demand", **{head: head for head in COLUMNS}}
    return BenchmarkReport(f"cavmarl (SUMO), {seconds} s, seeds {seeds}", columns, rows, notes)


def _both(
    ours: Sequence[TrafficFigures], sumo: Sequence[TrafficFigures], figure: str, form: str
) -> str:
    read = attrgetter(figure)
    return f"{_range([*map(read, ours)], form)} ({_range([*map(read, sumo)], form)})"


def _range(values: Sequence[float | None], form: str) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    least, most = (format(value, form) for value in (min(known), max(known)))
    return least if least == most else f"{least} to {most}"


if __name__ == "__main__":
    run(measure)
