"""Generated traffic with several drivers side by side, and SUMO's drivers with the same trips.

Every side begins with the same number of vehicles. In cavmarl, a vehicle that leaves is replaced.
SUMO gets the trips of the first side: its vehicles depart at the same times and places.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.registry import entries
from cavmarl.core.errors import ConfigError
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import find_map, load_world
from cavmarl.evaluate.traffic.native_side import run_native
from cavmarl.evaluate.traffic.sumo_side import SumoJob, run_seeds
from cavmarl.evaluate.traffic.traffic_metrics import TrafficFigures, TrafficRun
from cavmarl.roads.network import RoadNetwork
from cavmarl.traffic.sumo.sumo_input import read_input

CTRL_DT_S = 0.2  # time between two actions of a network, as in the training of the bundled drivers
TRIP_HORIZON = 3.0  # `traffic.trip_horizon`, as in the training of the bundled drivers
_TYPE = '<vType id="car" length="5" width="2" height="1.6"/>'  # the generator's car, SUMO's driver

Model = str | Mapping[str, float]


@dataclass(frozen=True)
class ModelRun:
    """The traffic of one side."""

    name: str  # the driver, or the drivers with their shares
    figures: TrafficFigures
    removed: int | None  # vehicles removed after a contact, off the road or out of time; SUMO: None


@dataclass(frozen=True)
class ModelComparison:
    """Result of the comparison."""

    map_name: str
    vehicles: int  # number at the beginning of each run
    seconds: int
    dt_s: float
    seed: int
    sides: tuple[ModelRun, ...]  # cavmarl's in the order of the models, then SUMO's

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a JSON value."""
        found = asdict(self)
        for side, run in zip(found["sides"], self.sides, strict=True):
            side["figures"]["contacts_per_1000_km"] = run.figures.contacts_per_1000_km
        return found


def name_of(model: Model) -> str:
    """Return the text of a driver, or of drivers with their shares."""
    if isinstance(model, str):
        return model
    return ", ".join(f"{name} {share:g}" for name, share in model.items())


def compare_models(
    map_name: str | Path,
    models: Sequence[Model],
    *,
    vehicles: int,
    seconds: int = 900,
    dt_s: float = 0.1,
    seed: int = 0,
    teleports: bool = True,
    progress: Callable[[str], None] = lambda text: None,
) -> ModelComparison:
    """Run and measure the generated traffic of each model, and SUMO's traffic.

    Args:
        map_name: name or folder of an environment, or a map file.
        models: values of `traffic.model`.
        vehicles: number of vehicles at the beginning.
        seconds: duration.
        dt_s: step length of both simulators; a whole number of steps makes up `CTRL_DT_S`.
        seed: seed of all sides.
        teleports: whether SUMO may teleport vehicles that wait too long.
        progress: called with a text about the current work.

    Raises:
        ConfigError: a wrong number, or a model that does not exist.
        PolicyError: background vehicles cannot have a driver.
        CapacityError: the map has too little room.
        MapError: the map cannot be read or driven.
        MissingExtraError: SUMO is not installed.
    """
    if not models:
        raise ConfigError("models = []: name at least one driver, such as IDM")
    if vehicles < 1:
        raise ConfigError(f"background = {vehicles}: must be 1 or more")
    steps = CTRL_DT_S / dt_s if dt_s > 0.0 else 0.0
    if steps < 1.0 or abs(steps - round(steps)) > 1e-6:
        raise ConfigError(
            f"dt = {dt_s:g}: {CTRL_DT_S:g} s, the time between two actions of a network, must be a "
            "whole number of steps; try 0.1"
        )
    if not 1 <= seconds <= 100_000:
        raise ConfigError(f"seconds = {seconds}: must be from 1 to 100000")
    path = find_map(map_name)
    sides: list[ModelRun] = []
    trips = SumoTrips()
    for model in models:
        progress(name_of(model))
        world = _world(path, model, vehicles, seconds, dt_s, seed)
        run = _run(world, seconds, None if sides else trips)
        sides.append(ModelRun(name_of(model), run.figures, world.traffic_stats().removed))
    progress("SUMO")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "trips.rou.xml"
        trips.write(file)
        job = SumoJob(path, read_input([file]), seconds, dt_s, seed, teleports)
        sumo, _ = run_seeds(job, ())
    sides.append(ModelRun("SUMO", sumo.figures, None))
    name = path.name.removesuffix(".gz").removesuffix(".net.xml")
    if str(map_name) in entries():
        name = str(map_name)
    return ModelComparison(name, vehicles, seconds, dt_s, seed, tuple(sides))


def _world(
    path: Path, model: Model, vehicles: int, seconds: int, dt_s: float, seed: int
) -> Simulation:
    """Return a world of generated vehicles after its reset."""
    own = {
        "clock.sim_dt_s": dt_s,
        "clock.ctrl_dt_s": CTRL_DT_S,
        "horizon_s": float(seconds),
        "population.mode": "respawn",
        "traffic.trip_horizon": TRIP_HORIZON,
        "traffic.model": model if isinstance(model, str) else dict(model),
    }
    config, network, demand, partition = load_world(
        path, agents=0, background=vehicles, overrides=own
    )
    world = Simulation(config, network, demand=demand, partition=partition)
    world.seed(seed)
    world.reset()
    return world


def _run(world: Simulation, seconds: int, trips: SumoTrips | None) -> TrafficRun:
    """Run and measure a world; record its trips if requested."""
    if trips is None:
        return run_native(world, seconds)
    trips.note(world)
    return run_native(world, seconds, trips.note)


class SumoTrips:
    """The trips of the vehicles of a world, for SUMO."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._next_id = 0

    def note(self, world: Simulation) -> None:
        """Add the trips of the vehicles that are new in a world."""
        rows = world.vehicles()
        new = rows[rows["id"] >= self._next_id]
        if not len(new):
            return
        self._next_id = int(new["id"].max()) + 1
        tick_s = world.config.clock.sim_dt_s
        for row in new[np.argsort(new["id"])]:
            self._lines.append(_trip(world.network, world.goal_edges[0], row, tick_s))

    def write(self, path: Path) -> None:
        """Write a route file of SUMO."""
        text = "\n".join(["<routes>", _TYPE, *self._lines, "</routes>", ""])
        path.write_text(text, encoding="utf-8")


def _trip(network: RoadNetwork, goal_edges: NDArray[np.int32], row: np.void, tick_s: float) -> str:
    """Return the trip of a vehicle that has just entered."""
    lane, goal = int(row["lane"]), int(goal_edges[row["goal"]])
    index = network.lane_ids[lane].rpartition("_")[2]
    values = {
        "id": str(row["id"]),
        "type": "car",
        "depart": f"{row['departed'] * tick_s:.2f}",
        "from": network.edge_ids[int(network.lanes["edge"][lane])],
        "to": network.edge_ids[goal],
        "departLane": index,
        "departPos": f"{row['s'] + 0.5 * row['length']:.2f}",
        "departSpeed": "max",
    }
    return f"<trip {' '.join(f'{key}={quoteattr(value)}' for key, value in values.items())}/>"
