"""Worlds with SUMO beside them, and SUMO's own run of the same files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from cavmarl.runtime.simulation import Simulation
from cavmarl.traffic.sumo.demand import SumoDemand
from cavmarl.traffic.sumo.options import free_libsumo
from tests.demand_worlds import TINY, make
from tests.driving import start

MODES = ("sumo-traffic", "sumo-demand")


def tiny_file(folder: Path, env: str = "grid4x4") -> Path:
    """The demand of one of `TINY`."""
    path = folder / f"{env}.rou.xml"
    path.write_text(TINY[env], encoding="utf-8")
    return path


@contextmanager
def coupled(
    env: str | Path,
    files: Sequence[Path],
    source: str = "sumo-traffic",
    *,
    seed: int | None = 1,
    overrides: Mapping[str, Any] | None = None,
    **options: Any,
) -> Iterator[Simulation]:
    """Worlds from their reset on, unless the seed is None; no process is left of them."""
    wanted = {"traffic.source": source, "sensors.signal.timing": False, **(overrides or {})}
    simulation = make(env, files, overrides=wanted, **options)
    try:
        if seed is not None:
            start(simulation, seed)
        yield simulation
    finally:
        simulation.close()


def demand_of(simulation: Simulation) -> SumoDemand:
    assert isinstance(simulation.demand, SumoDemand)
    return simulation.demand


@contextmanager
def alone(simulation: Simulation, folder: Path, begin: int = 0) -> Iterator[Any]:
    """libsumo in this process, at the beginning of what the first world's SUMO runs."""
    libsumo: Any = free_libsumo()
    seed = int(simulation.worlds.keys[0]) >> 33
    demand = demand_of(simulation)
    assert replace(demand).dt_s == simulation.config.clock.sim_dt_s
    libsumo.start(["sumo", *demand.words(folder, seed)])
    try:
        yield libsumo
    finally:
        libsumo.close()
