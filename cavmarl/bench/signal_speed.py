"""Speed of worlds whose signals follow max pressure, compared with sumo-rl on libsumo.

Both sides decide every 5 s. A step of cavmarl has 25 ticks of 0.2 s; a step of sumo-rl has five
simulation steps of 1 s. The sides take turns on the same core; rates use processor time.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from cavmarl.bench import sumo_rl_side
from cavmarl.bench.harness import (
    Say,
    Spread,
    check_range,
    one_core,
    silent,
    spread,
    take_turns,
)
from cavmarl.core.errors import ConfigError
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import load_world
from cavmarl.evaluate.traffic.native_side import idle_commands
from cavmarl.signals.controllers import MaxPressure
from cavmarl.traffic.sumo.sumo_input import read_input

PYTHON = "CAVMARL_SUMO_RL_PYTHON"  # environment variable: a Python with sumo-rl and libsumo
DECIDE_S, TICK_S = 5.0, 0.2


@dataclass(frozen=True)
class SignalSpeed:
    """Result of the comparison; rates are decisions of a world per second of processor time."""

    map_name: str
    signals: int
    after_s: int  # simulated seconds before the first turn
    turn: int  # number of decisions of a turn
    repeats: int
    ours: dict[int, Spread]  # number of worlds → rates
    sumo_rl: Spread
    ratios: dict[int, float]  # number of worlds → ratio of the medians


def measure_signal_speed(
    sumo_config: Path,
    *,
    worlds: tuple[int, ...] = (1, 16),
    after_s: int = 300,
    turn: int = 60,
    repeats: int = 5,
    seed: int = 0,
    progress: Say = silent,
) -> SignalSpeed:
    """Measure both sides in turn on one core.

    Raises:
        ConfigError: the map is no .sumocfg with a network and one route file; or sumo-rl is not
            installed.
    """
    check_range(after=(after_s, 5, 3600), turn=(turn, 1, 720), repeats=(repeats, 1, 100))
    given = read_input([sumo_config])
    routes = [path for path in given.route_files if path.name.endswith(".rou.xml")]
    if given.net_file is None or len(routes) != 1:
        raise ConfigError(f"{sumo_config}: must name a network and one route file (.rou.xml)")
    before = round(after_s / DECIDE_S)
    sides: dict[int, Callable[[], float]] = {}
    name, count = "", 0
    for number in worlds:
        progress(f"{number} worlds, the first {after_s} s")
        simulation = _world(sumo_config, number, after_s + DECIDE_S * (turn * repeats + 1), seed)
        name, count = simulation.network.name, len(simulation.signals.table.ids)
        step = _stepper(simulation)
        step(before)
        sides[number] = lambda step=step: step(turn)  # type: ignore[misc]
    begin = f"{given.begin_s or 0.0:g}"
    words = [str(given.net_file), str(routes[0]), str(before), str(turn), begin]
    python = os.environ.get(PYTHON, sys.executable)
    with one_core(), subprocess.Popen(
        [python, str(Path(sumo_rl_side.__file__)), *words],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        progress(f"sumo-rl's first {after_s} s")
        _answer(process, "ready")

        def turn_of_sumo_rl() -> float:
            assert process.stdin is not None
            process.stdin.write("\n")
            process.stdin.flush()
            return float(_answer(process, ""))

        turns = take_turns({0: turn_of_sumo_rl, **sides}, repeats, progress)
    rates = {
        number: spread(max(number, 1) * turn / seconds for seconds in found)
        for number, found in turns.items()
    }
    theirs = rates.pop(0)
    ratios = {number: found.median / theirs.median for number, found in rates.items()}
    return SignalSpeed(name, count, after_s, turn, repeats, rates, theirs, ratios)


def _world(sumo_config: Path, worlds: int, horizon_s: float, seed: int) -> Simulation:
    keys = {
        "signals.agents": "all",
        "signals.max_green_s": 0.0,
        "clock.sim_dt_s": TICK_S,
        "clock.ctrl_dt_s": DECIDE_S,
        "horizon_s": horizon_s,
    }
    found = load_world(sumo_config, agents=0, background=0, overrides=keys)
    simulation = Simulation(
        found.config, found.network, worlds, demand=found.demand, partition=found.partition
    )
    simulation.seed(seed)
    simulation.reset()
    return simulation


def _stepper(simulation: Simulation) -> Callable[[int], float]:
    """Return a function that makes a number of decisions, and returns its processor time in s."""
    view, controller = simulation.signal_view(), MaxPressure()
    commands = idle_commands(simulation)

    def run(count: int) -> float:
        began_s = time.process_time()
        for _ in range(count):
            simulation.step(replace(commands, signal_choices=controller.choose(view)))
        return time.process_time() - began_s

    return run


def _answer(process: subprocess.Popen[str], wanted: str) -> str:
    """Return the next line that sumo-rl's side prints, skipping lines of SUMO."""
    assert process.stdout is not None and process.stderr is not None  # noqa: PT018
    for line in process.stdout:
        word = line.strip()
        if word == wanted or (not wanted and word.replace(".", "").isdigit()):
            return word
    words = process.stderr.read().strip().splitlines()
    raise ConfigError(
        f"sumo-rl ended: {words[-1] if words else 'no output'}\nCure: install sumo-rl and "
        f"eclipse-sumo's libsumo in a Python, and set {PYTHON} to it"
    )
