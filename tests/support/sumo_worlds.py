"""Worlds that are coupled with SUMO, and runs of the same files by SUMO alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from cavmarl.engine.simulation import Simulation
from cavmarl.traffic.sumo.sumo_demand import SumoDemand
from cavmarl.traffic.sumo.sumo_input import free_libsumo
from tests.support.demand_worlds import TINY, make
from tests.support.driving import start

MODES = ("sumo-traffic", "sumo-demand")

# The files have a bus stop in an additional file, a stop at a position on a lane, a stop at a
# position before the end of a lane, and a stop that belongs to a route.
STOPPING_PLACES = """<additional>
  <busStop id="market" lane="main_in_0" startPos="80" endPos="110" lines="1"/>
</additional>"""
STOPPING = """<routes>
  <vType id="car" sigma="0" speedDev="0"/>
  <vType id="bus" vClass="bus" sigma="0" speedDev="0"/>
  <route id="straight" edges="main_in weave main_out"/>
  <route id="pause" edges="main_in weave main_out">
    <stop lane="main_out_0" endPos="-20" duration="3"/>
  </route>
  <vehicle id="bus" type="bus" route="straight" depart="1" departLane="0">
    <stop busStop="market" duration="6" until="25"/>
    <stop lane="main_out_0" startPos="30" endPos="60" duration="4"/>
  </vehicle>
  <vehicle id="van" type="car" route="pause" depart="4" departLane="1"/>
  <vehicle id="car" type="car" route="straight" depart="8" departLane="1"/>
  <vehicle id="taxi" type="car" route="straight" depart="12" departLane="0">
    <stop lane="weave_0" endPos="40" duration="0" speed="5"/>
    <stop lane="main_out_0" endPos="90" duration="2" parking="true"/>
  </vehicle>
  <flow id="more" type="car" route="pause" begin="20" end="50" period="6" departLane="1"/>
</routes>"""


def tiny_file(folder: Path, env: str = "grid4x4") -> Path:
    """Write the demand file of an environment in `TINY`."""
    path = folder / f"{env}.rou.xml"
    path.write_text(TINY[env], encoding="utf-8")
    return path


def write_stops(folder: Path) -> list[Path]:
    """Write the files of a demand on `merge` with stops of vehicles and of routes."""
    paths = [folder / "stops.add.xml", folder / "stops.rou.xml"]
    for path, text in zip(paths, (STOPPING_PLACES, STOPPING), strict=True):
        path.write_text(text, encoding="utf-8")
    return paths


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
    """Yield worlds coupled with SUMO, reset unless the seed is None; close them after the block."""
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
    """Yield libsumo, started in this process with the files and the seed of the first world."""
    libsumo: Any = free_libsumo()
    seed = int(simulation.worlds.keys[0]) >> 33
    demand = demand_of(simulation)
    assert replace(demand).dt_s == simulation.config.clock.sim_dt_s
    libsumo.start(["sumo", *demand.words(folder, seed)])
    try:
        yield libsumo
    finally:
        libsumo.close()
