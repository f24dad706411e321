"""Runs of the same demand in cavmarl and in SUMO, side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from cavmarl.core.errors import ConfigError
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import find_map
from cavmarl.evaluate.traffic.native_side import make_world, run_native
from cavmarl.evaluate.traffic.sumo_side import SumoJob, run_seeds
from cavmarl.evaluate.traffic.traffic_metrics import EDGE_MINUTE, TrafficFigures, TrafficRun
from cavmarl.traffic.demand import DemandFile
from cavmarl.traffic.sumo.sumo_input import read_input

MAX_SECONDS = 100_000
RATIOS = ("departed", "waiting", "arrived", "mean_speed_mps", "mean_delay_s", "queue")


@dataclass(frozen=True)
class TrafficComparison:
    """Result of the comparison."""

    map_name: str  # the map's name
    seconds: int  # duration of both runs
    dt_s: float  # step length of both runs
    seed: int  # seed of both runs
    ours: TrafficRun  # cavmarl's run
    sumo: TrafficRun  # SUMO's run
    edge_ids: tuple[str, ...]  # ids of the map's edges, by EDGE row
    # parts of the demand that were left out or approximated, with counts
    tolerated: tuple[str, ...] = ()
    sumo_others: tuple[TrafficFigures, ...] = ()  # SUMO with further seeds, without contacts

    def ratio(self, figure: str) -> float | None:
        """Return cavmarl's value over SUMO's; None if SUMO's is zero or a value is missing."""
        ours, sumo = getattr(self.ours.figures, figure), getattr(self.sumo.figures, figure)
        return ours / sumo if figure in RATIOS and ours is not None and sumo else None

    def to_dict(self) -> dict[str, Any]:
        sides = {
            name: {
                "figures": asdict(run.figures),
                "locks_s": run.locks_s,
                "edge_minutes": {
                    key: run.edge_minutes[key].tolist() for key in EDGE_MINUTE.names or ()
                }
                | {"edge": [self.edge_ids[row] for row in run.edge_minutes["edge"].tolist()]},
            }
            for name, run in (("ours", self.ours), ("sumo", self.sumo))
        }
        run = {"map": self.map_name, "seconds": self.seconds, "dt_s": self.dt_s, "seed": self.seed}
        ratios = {name: self.ratio(name) for name in RATIOS}
        others = [asdict(figures) for figures in self.sumo_others]
        more = {"ratios": ratios, "tolerated": list(self.tolerated), "sumo_others": others}
        return run | sides | more


def compare_traffic(
    map_name: str | Path,
    demand: Sequence[Path],
    *,
    seconds: int = 900,
    dt_s: float = 0.1,
    seed: int = 0,
    teleports: bool = True,
    sumo_seeds: int = 1,
    finished: Callable[[Simulation], None] = lambda world: None,
    progress: Callable[[str], None] = lambda text: None,
) -> TrafficComparison:
    """Run and measure both simulators; SUMO gets only the demand that cavmarl supports.

    Args:
        map_name: name or folder of an environment, a map file or a .sumocfg.
        demand: route files and additional files, or one `.sumocfg`.
        seconds: duration from the beginning of the demand.
        dt_s: step length; a second is a whole number of steps.
        seed: seed of both simulators.
        teleports: whether SUMO may teleport vehicles that wait too long.
        sumo_seeds: number of seeds of SUMO, from `seed` on.
        finished: called with cavmarl's world at its end.
        progress: called with a text about the current work.

    Raises:
        ConfigError: a wrong number, or a demand that SUMO rejects.
        DemandError: an invalid demand, or a demand that does not fit the map.
        MapError: the map cannot be read or driven.
        MissingExtraError: SUMO is not installed.
    """
    if not 1 <= seconds <= MAX_SECONDS:
        raise ConfigError(f"seconds = {seconds}: must be from 1 to {MAX_SECONDS}")
    if not 0.0 < dt_s <= 1.0 or abs(1.0 / dt_s - round(1.0 / dt_s)) > 1e-6:
        raise ConfigError(f"dt = {dt_s:g}: a second must be a whole number of steps; try 0.1")
    given = read_input(demand)
    path = find_map(map_name)
    progress("the demand")
    # Run cavmarl first: its errors name file and line.
    world = make_world(path, demand, seconds, seed, dt_s)
    progress("SUMO's run")
    shared = frozenset(world.demand.element_ids) if isinstance(world.demand, DemandFile) else None
    if isinstance(world.demand, DemandFile):
        given = replace(given, begin_s=world.demand.begin_ms / 1000.0)
    job = SumoJob(path, given, seconds, dt_s, seed, teleports, shared)
    sumo, others = run_seeds(job, range(seed + 1, seed + sumo_seeds))
    progress("our run")
    ours = run_native(world, seconds)
    finished(world)
    name = path.name.removesuffix(".gz").removesuffix(".net.xml")
    tolerated = () if world.demand is None else world.demand.tolerated
    edges = tuple(world.network.edge_ids)
    figures = tuple(other.figures for other in others)
    return TrafficComparison(name, seconds, dt_s, seed, ours, sumo, edges, tolerated, figures)
