"""The environments of RESCO that sumo-rl names, from a user's folder of maps.

Ault and Sharon: "Reinforcement learning benchmarks for traffic signal control", 2021. The maps have
non-commercial licences or the GPL, so this package does not contain them.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

from cavmarl.adapters.sumo_rl.environment.env import env, parallel_env
from cavmarl.core.errors import ConfigError

NETS = "SUMO_RL_NETS"  # environment variable with the folder of maps


class _Scenario(NamedTuple):
    routes: str  # file of routes
    begin_s: int = 0


_MORNING, _AFTERNOON = 25_200, 57_600  # begin of the demand, s after midnight
_SCENARIOS = {
    "grid4x4": _Scenario("grid4x4_1.rou.xml"),
    "arterial4x4": _Scenario("arterial4x4_1.rou.xml"),
    "cologne1": _Scenario("cologne1.rou.xml", _MORNING),
    "cologne3": _Scenario("cologne3.rou.xml", _MORNING),
    "cologne8": _Scenario("cologne8.rou.xml", _MORNING),
    "ingolstadt1": _Scenario("ingolstadt1.rou.xml", _AFTERNOON),
    "ingolstadt7": _Scenario("ingolstadt7.rou.xml", _AFTERNOON),
    "ingolstadt21": _Scenario("ingolstadt21.rou.xml", _AFTERNOON),
}


def _make(name: str, parallel: bool, nets: str | Path | None, arguments: dict[str, Any]) -> Any:
    """Make an environment; the caller's arguments replace the scenario's."""
    folder = _folder(name, nets)
    scenario = _SCENARIOS[name]
    given = {
        "net_file": str(folder / f"{name}.net.xml"),
        "route_file": str(folder / scenario.routes),
        "begin_time": scenario.begin_s,
        "num_seconds": 3600,
        **arguments,
    }
    return parallel_env(**given) if parallel else env(**given)


def _folder(name: str, nets: str | Path | None) -> Path:
    """Return the folder of a scenario, within `nets` or its folder `RESCO`."""
    root = nets or os.environ.get(NETS)
    if not root:
        raise ConfigError(
            f"{name}: the maps of RESCO are not part of cavmarl; pass nets=FOLDER or set {NETS}. "
            "The folder is sumo_rl/nets of sumo-rl, or that of RESCO's own maps"
        )
    for folder in (Path(root) / name, Path(root) / "RESCO" / name):
        if (folder / f"{name}.net.xml").is_file():
            return folder
    raise ConfigError(
        f"{name}: {str(root)!r} has no {name}/{name}.net.xml, nor has its folder RESCO; pass "
        f"nets=FOLDER or set {NETS} to a folder with the maps of RESCO"
    )


def grid4x4(parallel: bool = True, nets: str | Path | None = None, **arguments: Any) -> Any:
    """Return a grid of 16 signals; for other arguments, see `SumoEnvironment`."""
    return _make("grid4x4", parallel, nets, arguments)


def arterial4x4(parallel: bool = True, nets: str | Path | None = None, **arguments: Any) -> Any:
    """Return a grid of 16 signals on arterial roads; see `grid4x4`."""
    return _make("arterial4x4", parallel, nets, arguments)


def cologne1(parallel: bool = True, nets: str | Path | None = None, **arguments: Any) -> Any:
    """Return a signal of Cologne; see `grid4x4`."""
    return _make("cologne1", parallel, nets, arguments)


def cologne3(parallel: bool = True, nets: str | Path | None = None, **arguments: Any) -> Any:
    """Return three signals of Cologne; see `grid4x4`."""
    return _make("cologne3", parallel, nets, arguments)


def cologne8(parallel: bool = True, nets: str | Path | None = None, **arguments: Any) -> Any:
    """Return eight signals of Cologne; see `grid4x4`."""
    return _make("cologne8", parallel, nets, arguments)


def ingolstadt1(parallel: bool = True, nets: str | Path | None = None, **arguments: Any) -> Any:
    """Return a signal of Ingolstadt; see `grid4x4`."""
    return _make("ingolstadt1", parallel, nets, arguments)


def ingolstadt7(parallel: bool = True, nets: str | Path | None = None, **arguments: Any) -> Any:
    """Return seven signals of Ingolstadt; see `grid4x4`."""
    return _make("ingolstadt7", parallel, nets, arguments)


def ingolstadt21(parallel: bool = True, nets: str | Path | None = None, **arguments: Any) -> Any:
    """Return 21 signals of Ingolstadt; see `grid4x4`."""
    return _make("ingolstadt21", parallel, nets, arguments)
