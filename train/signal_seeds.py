"""Signals trained with several seeds on RESCO's maps, and compared with scripted controllers.

    python train/signal_seeds.py --maps nets/RESCO --out docs/figures/signal_control.json
    python train/signal_seeds.py --table docs/figures/signal_control.json

The first command trains on each map with each seed (`signals_sb3.py`, one training at a time), runs
the scripted controllers in the same worlds, and writes all figures after each training or run. If
the command is interrupted, run it again to continue. The second command prints the table. The 95 %
interval of a trained network covers the spread between training seeds. The 95 % interval of a
scripted controller covers the spread between evaluation runs.

The maps are in the wheel of sumo-rl (`sumo_rl/nets/RESCO`). Their licences are non-commercial or
the GPL, so the package does not contain them.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from cavmarl.core.errors import ConfigError
from cavmarl.evaluate.signals.signal_meter import SignalFigures
from cavmarl.evaluate.signals.signal_runs import OWN_PROGRAM, run_controller
from cavmarl.evaluate.statistics import mean_interval
from cavmarl.learning.checkpoint import writing
from cavmarl.learning.options import run_to_end

PROGRAM = Path(__file__).with_name("signals_sb3.py")
FIRST_SEED, NUM_RUNS, SECONDS = 1000, 5, 3600  # evaluation, as in `signals_sb3.py`
RANGE_M = 50.0
# Number of parallel worlds in a training on each map; maps with more signals have fewer worlds.
WORLDS = {
    "grid4x4": 2,
    "arterial4x4": 2,
    "cologne1": 4,
    "cologne3": 4,
    "ingolstadt1": 4,
    "ingolstadt7": 4,
}
KEPT = ("delay_of_all_s", "arrived", "never_departed", "jams")  # figures of each run
LAST_LANE = "last lane: "  # prefix of controllers that only count vehicles on the last lane
LONG_LANES = ("grid4x4", "arterial4x4")  # maps with last lanes longer than `RANGE_M`
SCRIPTED: dict[str, tuple[str, float]] = {
    OWN_PROGRAM: (OWN_PROGRAM, RANGE_M),
    "program": ("program", RANGE_M),
    "longest_queue": ("longest_queue", RANGE_M),
    "max_pressure": ("max_pressure", RANGE_M),
    f"{LAST_LANE}longest_queue": ("longest_queue", 0.0),
    f"{LAST_LANE}max_pressure": ("max_pressure", 0.0),
}

Runs = list[dict[str, Any]]


def train(env: Path, seed: int, runs: Path) -> Runs:
    """Return the evaluation of a training with this seed; train if it does not exist."""
    name = env.name.split(".")[0]
    found = runs / f"{name}_signals_{seed}" / "evaluation.json"
    if not found.is_file():
        words = ["--env", env, "--seed", seed, "--runs", runs, "--num-worlds", WORLDS[name]]
        words += ["--evaluations", NUM_RUNS, "--horizon-s", SECONDS, "--no-compare"]
        subprocess.run([sys.executable, PROGRAM, *map(str, words)], check=True)
    return [{name: run[name] for name in KEPT} for run in json.loads(found.read_text())["PPO"]]


def script(env: Path, name: str) -> Runs:
    """Return the figures of a scripted controller in the worlds of the evaluation."""
    controller, range_m = SCRIPTED[name]
    found: list[SignalFigures] = run_controller(
        env,
        controller,
        seconds=SECONDS,
        seeds=range(FIRST_SEED, FIRST_SEED + NUM_RUNS),
        overrides={
            "population.mode": "open",
            "population.background": 0,
            "signals.max_green_s": 0.0,
            "signals.range_m": range_m,
        },
    )
    return [{name: getattr(run, name) for name in KEPT} for run in found]


def measure(maps: Path, seeds: Sequence[int], out: Path, runs: Path) -> None:
    """Measure all figures that the file does not have, and add them to the file."""
    envs = {name: maps / name / f"{name}.sumocfg" for name in WORLDS}
    for env in envs.values():
        if not env.is_file():
            raise ConfigError(f"--maps {maps}: has no file {env}; give RESCO's folder of maps")
    found: dict[str, Any] = {name: {"scripted": {}, "trained": {}} for name in WORLDS}
    if out.is_file():
        found |= json.loads(out.read_text())["maps"]
    steps = [(name, "scripted", each) for name in WORLDS for each in SCRIPTED]
    steps += [(name, "trained", str(seed)) for seed in seeds for name in WORLDS]
    for name, kind, each in steps:
        if each in found[name][kind]:
            continue
        known = found[name][kind].get(each.removeprefix(LAST_LANE))
        if known is not None and name in LONG_LANES:  # no lane is shorter than the range
            found[name][kind][each] = known
        elif kind == "scripted":
            found[name][kind][each] = script(envs[name], each)
        else:
            found[name][kind][each] = train(envs[name], int(each), runs)
        words = " ".join(map(str, seeds))
        content = {
            "command": f"python train/signal_seeds.py --maps RESCO --seeds {words}",
            "date": f"{datetime.now(UTC):%Y-%m-%d}",
            "evaluation_seeds": [*range(FIRST_SEED, FIRST_SEED + NUM_RUNS)],
            "maps": found,
        }
        with writing(out):
            out.write_text(json.dumps(content, indent=1) + "\n")


def table(maps: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of the table: delays of all trips, and the number of runs that jam."""
    yield f"| map | seeds | trained | {' | '.join(f'`{name}`' for name in SCRIPTED)} |"
    yield f"| --- {'| ---: ' * (len(SCRIPTED) + 2)}|"
    for name, found in maps.items():
        trained = [*found["trained"].values()]
        means = [np.mean([run["delay_of_all_s"] for run in runs]) for runs in trained]
        cells = [_cell(means, [run for runs in trained for run in runs])]
        for each in SCRIPTED:
            runs = found["scripted"][each]
            cells.append(_cell([run["delay_of_all_s"] for run in runs], runs))
        yield f"| `{name}` | {len(trained)} | {' | '.join(cells)} |"


def _cell(values: Sequence[Any], runs: Runs) -> str:
    if not values:
        return "-"
    interval = mean_interval(np.array(values, dtype=np.float64))
    spread = "" if interval is None else f" [{interval.low:.1f}, {interval.high:.1f}]"
    jams = sum(run["jams"] for run in runs)
    median = np.median([run["delay_of_all_s"] for run in runs])
    jammed = f", {jams} of {len(runs)} jam" if jams else ""
    return f"{np.mean(values):.1f}{spread} ({median:.1f}){jammed}"


def main(words: Sequence[str] | None = None) -> int:
    """Measure, or print the table; return 0: done, 2: an error, 130: interrupted."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--maps", type=Path, help="RESCO's folder of maps")
    parser.add_argument("--seeds", type=int, nargs="+", default=[*range(5)], help="training seeds")
    parser.add_argument("--out", type=Path, default=Path("runs/signal_control.json"))
    parser.add_argument("--runs", type=Path, default=Path("runs/signal_seeds"))
    parser.add_argument("--table", type=Path, metavar="FILE", help="print the table of this file")
    args = parser.parse_args(words)
    if args.table is None and args.maps is None:
        parser.error("give --maps FOLDER to measure, or --table FILE to print a table")

    def act() -> None:
        if args.maps is not None:
            measure(args.maps, args.seeds, args.out, args.runs)
        print("\n".join(table(json.loads((args.table or args.out).read_text())["maps"])))

    return run_to_end(act, "the same command continues")


if __name__ == "__main__":
    sys.exit(main())
