"""Speed advice and learned signals, alone and together, at several shares of lost messages.

All vehicles are agents with the driver `glosa` (advice) or `idm` (no advice). Signals follow the
map's programs, or networks that `train/signals_sb3.py` has trained with drivers `idm` or, for the
side `together`, with drivers `glosa`. The first run trains the networks and stores them.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from stable_baselines3 import PPO

from benchmarks.glosa import ADVISED, Driving, drive_worlds
from benchmarks.program import run
from cavmarl.adapters.sb3_green_policy import SharedNetwork
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import OptionalEnvironment, Seed, about
from cavmarl.core.errors import CavmarlError, ConfigError
from cavmarl.evaluate.statistics import mean_interval

TRAINING = Path(__file__).parent.parent / "train" / "signals_sb3.py"
# A tick takes 0.2 s. Only roadside units at signals send messages.
CONNECTED = ADVISED | {
    "v2x.cam.rate_hz": 0.0,
    "v2x.denm.rate_hz": 0.0,
    "v2x.roadside.rate_hz": 5.0,
}
RANGE_M = 50.0  # the default of the training
TRAINED_S = 900  # length of an episode of the training


class Side(NamedTuple):
    """A combination of drivers and signals."""

    name: str
    drivers: str
    trained_with: str  # drivers in the training of signals; empty: signals follow programs


SIDES = (
    Side("neither", "idm", ""),
    Side("advice", "glosa", ""),
    Side("signals", "idm", "idm"),
    Side("advice beside signals", "glosa", "idm"),
    Side("together", "glosa", "glosa"),
)


def measure(
    env: OptionalEnvironment = "grid4x4",
    agents: Annotated[int, about("Vehicles of a world.")] = 40,
    worlds: Annotated[int, about("Number of worlds; each has different trips.")] = 8,
    seconds: Annotated[int, about("Simulated time.")] = 900,
    decide_s: Annotated[float, about("Seconds between two decisions of a signal.")] = 5.0,
    loss: Annotated[
        list[float] | None, typer.Option("--loss", help="Share of lost messages; repeatable.")
    ] = None,
    side: Annotated[
        list[str] | None, typer.Option("--side", help="Side to measure; repeatable.")
    ] = None,
    updates: Annotated[int, about("Updates of a training.")] = 60,
    networks: Annotated[Path, about("Folder of the trained networks.")] = Path("runs/joint"),
    seed: Seed = 0,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure delay and stops of vehicles with speed advice, learned signals, or both."""
    check_range(worlds=(worlds, 1, 100), seconds=(seconds, 10, 36_000), agents=(agents, 1, 1000))
    losses = loss or [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]
    named: dict[str, Any] = {"agents": agents, "decide_s": decide_s, "updates": updates}
    rows: list[Mapping[str, Any]] = []
    for chosen in _chosen(side):
        network = None
        if chosen.trained_with:
            say(f"training with {chosen.trained_with}")
            network = _network(env, chosen.trained_with, networks, seed, **named)
        for share in losses if chosen.drivers == "glosa" else losses[:1]:
            say(f"{chosen.name}, {share:.0%} lost")
            found = drive_worlds(
                chosen.drivers,
                env,
                agents=agents,
                worlds=worlds,
                seconds=seconds,
                seed=1000 + seed,
                controller=network,
                overrides=_keys(share, decide_s if network else None),
            )
            lost = share if chosen.drivers == "glosa" else None
            rows.append({"side": chosen.name, "loss": lost, **_figures(found)})
    return BenchmarkReport(
        f"{env}, {agents} vehicles, {worlds} worlds, {seconds} s, decisions every {decide_s:g} s",
        {
            "side": "side",
            "lost": "loss:.0%",
            "delay, s/km": "delay_s_per_km:.1f",
            "±": "delay_within:.1f",
            "stops per km": "stops_per_km:.2f",
            "± ": "stops_within:.2f",
            "speed, m/s": "speed_mps:.2f",
            "CO₂, g/km": "co2_g_per_km:.0f",
        },
        rows,
        notes=_savings(rows),
    )


def _chosen(names: Sequence[str] | None) -> list[Side]:
    """Return the sides of some names, or all."""
    known = {side.name: side for side in SIDES}
    for name in names or ():
        if name not in known:
            raise ConfigError(f"--side {name}: must be one of {', '.join(known)}")
    return [known[name] for name in names or known]


def _keys(loss: float, decide_s: float | None) -> dict[str, Any]:
    """Return the keys of worlds; `decide_s`: None if signals follow programs."""
    keys = {**CONNECTED, "v2x.channel.loss": loss, "clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 0.2}
    if decide_s is None:
        return keys
    signals = {
        "signals.agents": "all",
        "signals.decide_s": decide_s,
        "signals.max_green_s": 0.0,
        "signals.range_m": RANGE_M,
    }
    return keys | signals


def _network(
    env: str,
    drivers: str,
    folder: Path,
    seed: int,
    *,
    agents: int,
    decide_s: float,
    updates: int,
) -> SharedNetwork:
    """Return the network trained with the drivers; train it if the folder has none."""
    name = f"{Path(env).stem}_{drivers}_{agents}_{decide_s:g}_{updates}_{seed}"
    path = folder / name / "model.zip"
    if not path.is_file():
        words: Sequence[object] = [
            *("--env", env, "--runs", folder, "--name", name, "--seed", seed),
            *("--updates", updates, "--num-worlds", 2, "--horizon-s", TRAINED_S),
            *("--decide-s", decide_s, "--no-compare", "--evaluations", 1),
            *_vehicles(drivers, agents),
        ]
        done = subprocess.run(
            [sys.executable, str(TRAINING), *map(str, words)], capture_output=True, text=True
        )
        if done.returncode:
            raise CavmarlError(f"the training of signals ended: {done.stderr.strip()[-500:]}")
    return SharedNetwork(PPO.load(path, device="cpu"))


def _vehicles(drivers: str, agents: int) -> Sequence[object]:
    """Return the training's options for vehicles; `idm` means background vehicles."""
    if drivers == "idm":
        return ["--background", agents]
    settings = ",".join(f"{key}={json.dumps(value)}" for key, value in CONNECTED.items())
    return ["--background", 0, "--agents", agents, "--drivers", drivers, "--settings", settings]


def _savings(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return lines that say what advice saves over learned signals alone, paired by world."""
    alone = next((row for row in rows if row["side"] == "signals"), None)
    found = []
    for row in rows:
        if alone is None or row["side"] not in ("advice beside signals", "together"):
            continue
        parts = []
        for name, unit in (("delay_of_worlds", "s of delay"), ("stops_of_worlds", "stops")):
            saved = np.array(alone[name]) - np.array(row[name])
            interval = mean_interval(saved)
            bounds = "" if interval is None else f" [{interval.low:.2f}, {interval.high:.2f}]"
            parts.append(f"{saved.mean():.2f}{bounds} {unit}")
        lost = f"{row['side']}, {row['loss']:.0%} lost"
        found.append(f"{lost}: saves {' and '.join(parts)} per km against signals alone")
    return found


def _figures(found: Sequence[Driving]) -> dict[str, Any]:
    """Return means over worlds, half widths of their 95 % intervals, and each world's values."""
    values = np.array(found)
    kilometres = 1e-3 * values[:, Driving._fields.index("distance_m")]
    per_km = values / kilometres[:, None]
    means = dict(zip(Driving._fields, per_km.mean(axis=0).tolist(), strict=True))
    within = {}
    for name in ("delay_s", "stops"):
        interval = mean_interval(per_km[:, Driving._fields.index(name)])
        within[name] = None if interval is None else 0.5 * (interval.high - interval.low)
    return {
        "delay_s_per_km": means["delay_s"],
        "delay_within": within["delay_s"],
        "stops_per_km": means["stops"],
        "stops_within": within["stops"],
        "speed_mps": 1e3 / means["driven_s"],
        "co2_g_per_km": means["co2_g"],
        "delay_of_worlds": per_km[:, Driving._fields.index("delay_s")].tolist(),
        "stops_of_worlds": per_km[:, Driving._fields.index("stops")].tolist(),
    }


if __name__ == "__main__":
    run(measure)
