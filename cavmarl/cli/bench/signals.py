"""`cavmarl bench signals`: compares the speed of signal control with sumo-rl."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from cavmarl.bench.harness import BenchmarkReport, Say, silent
from cavmarl.cli.output import Seed, about


def signals(
    sumo_config: Annotated[
        Path,
        typer.Argument(metavar="MAP", help="A .sumocfg with a network and one route file."),
    ],
    worlds: Annotated[
        list[int] | None,
        about("Number of worlds. Repeat it for more [default: 1, 16].", metavar="N"),
    ] = None,
    after: Annotated[int, about("Simulated seconds before measuring.", metavar="S")] = 300,
    turn: Annotated[int, about("Decisions per measurement, one every 5 s.", metavar="N")] = 60,
    repeats: Annotated[int, about("Measurements of each program.", metavar="N")] = 5,
    seed: Seed = 0,
    say: Say = silent,
) -> BenchmarkReport:
    """Compare the speed of max pressure with sumo-rl on libsumo, in processor time.

    The environment variable CAVMARL_SUMO_RL_PYTHON names a Python that has sumo-rl.
    """
    from cavmarl.bench.signal_speed import measure_signal_speed

    found = measure_signal_speed(
        sumo_config,
        worlds=tuple(worlds or (1, 16)),
        after_s=after,
        turn=turn,
        repeats=repeats,
        seed=seed,
        progress=say,
    )
    rows = [
        {"side": f"cavmarl, {number} worlds", **asdict(rates), "ratio": found.ratios[number]}
        for number, rates in found.ours.items()
    ]
    return BenchmarkReport(
        f"{found.map_name}, {found.signals} signals, max pressure every 5 s, one core, "
        f"{found.repeats} turns, after {found.after_s} s",
        {
            "decisions/s of a world": "side",
            "min": "low:,.0f",
            "median": "median:,.0f",
            "max": "high:,.0f",
            "ratio": "ratio:.1f",
        },
        [*rows, {"side": "sumo-rl, libsumo", **asdict(found.sumo_rl), "ratio": 1.0}],
        facts=asdict(found),
    )
