"""The built-in driver in agents' seats, alone and in traffic, on any maps.

Every trip counts, including trips that the end of the run truncates. A vehicle stands without a
cause if it has stood for `STANDS_S` and none of these causes applies:

- its signal is red;
- another vehicle is close ahead, or just behind the junction;
- another vehicle, or only its rear, is on a path that crosses the path of this vehicle;
- a vehicle with priority approaches, within its `registration_distance_m`.

Contacts on lanes of different roads that overlap are counted separately (`shared_ground`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.program import run
from benchmarks.world_draw import draw_world
from benchmarks.world_files import cut_maps, make_net
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, numbers_of, silent
from cavmarl.cli.output import Seed, about
from cavmarl.core.errors import CavmarlError, ConfigError
from cavmarl.core.records.codes import SIGNAL_NONE
from cavmarl.driving.kernels.junctions.stop_line_registration import registration_distance_m
from cavmarl.engine.world_setup import load_world
from cavmarl.env.vector import CavVectorEnv
from cavmarl.evaluate.recorder import Recorder
from cavmarl.maps.shared_ground import LEVEL_M, shared_ground
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.roads.network import SIGNAL_STATES, RoadNetwork
from cavmarl.roads.shown_signals import signal_codes
from cavmarl.roads.sumo_net.reader import map_name

MOST_SHARE = 0.0005  # largest share of trips that may end off the road or in a collision
STANDS_S = 120.0
NEAR_AHEAD_M = 20.0  # a vehicle whose centre is at most this far ahead is a cause
AXIS_PLACES = 9  # number of points on a vehicle's axis
NEAR_AXIS_M = 4.0  # largest distance of the axes of touching vehicles
TOGETHER = 100  # approximate number of vehicles in all parallel worlds
RECORDED = ("off_road", "collision", "wrong_way", "red_light")
OF_TRIPS = (*RECORDED, "shared_ground")  # the last: collisions on shared ground
FAULTS = (*OF_TRIPS, "stands")
HEADS = {"collision": "colli-\nsion"}  # broken, so that the table fits 80 characters
SHOWN = 12  # number of faults below the table
GREEN = [SIGNAL_STATES.index(letter) for letter in "gGoOs"] + [SIGNAL_NONE]


@dataclass
class Drive:
    """Results of the trips of one driver on one map."""

    trips: int = 0
    arrived: int = 0
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(FAULTS, 0))
    faults: list[dict[str, Any]] = field(default_factory=list)  # faults with position and time

    def add(self, other: Drive) -> None:
        self.trips += other.trips
        self.arrived += other.arrived
        for name in FAULTS:
            self.counts[name] += other.counts[name]
        self.faults += other.faults

    @property
    def holds(self) -> bool:
        most = MOST_SHARE * self.trips
        rare = self.counts["off_road"] <= most and self.counts["collision"] <= most
        return rare and not (self.counts["wrong_way"] or self.counts["stands"])

    def row(self, name: str, model: str, agents: int) -> dict[str, Any]:
        shares = {fault: 100.0 * self.counts[fault] / max(self.trips, 1) for fault in OF_TRIPS}
        own = {"map": name, "model": model, "agents": agents, "trips": self.trips}
        own["driver"] = f"{model} {agents}"
        arrived = {"arrived": 100.0 * self.arrived / max(self.trips, 1)}
        return own | arrived | shares | {"stands": self.counts["stands"], "faults": self.faults}


def measure(
    maps: Annotated[
        list[str] | None, typer.Argument(help="Names, folders or map files of environments.")
    ] = None,
    worlds: Annotated[int, about("Number of additional random nets.")] = 0,
    first_seed: Annotated[int, about("Seed of the first random net.")] = 0,
    agents: Annotated[str, about("Comma-separated numbers of agents.")] = "1,100",
    models: Annotated[str, about("Car-following models: IDM, Krauss or both.")] = "IDM,Krauss",
    seconds: Annotated[int, about("Simulated seconds per run.")] = 300,
    seed: Seed = 0,
    say: Say = silent,
) -> BenchmarkReport:
    """Count trips of the built-in driver that end off the road, collide, or get stuck."""
    check_range(worlds=(worlds, 0, 10_000), seconds=(seconds, 1, 100_000))
    check_range(first_seed=(first_seed, 0, 10**9))
    crowds = numbers_of("--agents", agents)
    chosen = [name.strip() for name in models.split(",")]
    if not maps and not worlds:
        raise ConfigError("no map: give maps, or draw nets with --worlds")
    named = labels(maps or [])
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    sums = {(model, crowd): Drive() for model in chosen for crowd in crowds}
    with TemporaryDirectory() as folder:
        for name, make in _maps(named, range(first_seed, first_seed + worlds), Path(folder)):
            say(name)
            try:
                path = make()
                found = {key: drive(path, *key, seconds, seed) for key in sums}
            except CavmarlError as error:
                if name in named.values():
                    raise
                notes.append(f"{name} is left out: {error}")
                continue
            for key, driven in found.items():
                sums[key].add(driven)
                rows.append(driven.row(name, *key))
                notes += [_told(name, *key, fault) for fault in driven.faults]
    total = [drive.row("all", *key) | {"faults": []} for key, drive in sums.items()]
    columns = {"map": "map", "driver": "driver", "trips": "trips"}
    columns |= {HEADS.get(name, name.replace("_", "\n")): f"{name}:.2f" for name in OF_TRIPS}
    columns |= {"stand": "stands"}
    shown = [row for row in rows if not worlds or row["faults"] or row["map"] in named.values()]
    more = [f"and {len(notes) - SHOWN} more"] if len(notes) > SHOWN else []
    return BenchmarkReport(
        f"the built-in driver in agents' seats, {seconds} s: trips, shares of them in %, vehicles "
        f"that stand {STANDS_S:.0f} s without a cause",
        columns,
        [*shown, *total],
        notes[:SHOWN] + more,
        {"notes": notes, "seconds": seconds, "seed": seed, "maps": named},
        all(drive.holds for drive in sums.values()),
    )


def labels(maps: Sequence[str]) -> dict[str, str]:
    """Return a short label of each map: the file's name, if it is unique."""
    short = {name: map_name(Path(name)) or name for name in maps}
    number = Counter(short.values())
    return {name: label if number[label] == 1 else name for name, label in short.items()}


def _maps(
    named: Mapping[str, str], seeds: Sequence[int], folder: Path
) -> Iterator[tuple[str, Callable[[], str]]]:
    """Yield for each map its label and a function that returns its name, or makes its file."""
    for name, label in named.items():
        yield label, lambda name=name: name  # type: ignore[misc]
    cuts = cut_maps(None) if seeds else ()
    for seed in seeds:
        draw = draw_world(seed)
        yield (
            f"world {seed}: {' '.join(draw.features)}",
            lambda draw=draw: str(make_net(draw, folder / str(draw.seed), cuts)),  # type: ignore[misc]
        )


def _told(name: str, model: str, agents: int, fault: dict[str, Any]) -> str:
    place = f"({fault['x']:.1f}, {fault['y']:.1f}) on {fault['lane']} at {fault['time_s']:.1f} s"
    return f"{name}, {model}, {agents}: {fault['what']}, world {fault['world']}, {place}"


def drive(env: str, model: str, agents: int, seconds: int, seed: int) -> Drive:
    """Let the built-in driver drive a number of agents for some time."""
    overrides = {
        "traffic.model": model,
        "population.mode": "respawn",
        "horizon_s": float(seconds),
    }
    world = load_world(env, agents=agents, background=0, overrides=overrides)
    vec = CavVectorEnv(LocalWorlds(world, max(1, min(16, TOGETHER // (5 * agents)))))
    weights = np.array(vec.config.terms.weight_of_each)
    recorder = Recorder(vec.num_envs, vec.num_agents, vec.max_cycles, vec.step_s, weights)
    watch, ground = StandingVehicles(vec), SharedGround(vec.network)
    found = Drive()
    _, infos = vec.reset(seed=seed)
    running = np.ones(vec.num_envs, dtype=np.bool_)
    step = 0
    while running.any():
        before = [vec.simulation.vehicles(w).copy() for w in range(vec.num_envs)]
        _, rewards, _, _, infos = vec.step(vec.suggest_actions())
        acted = infos["acted"] & running[:, None]
        over = infos["episode_over"] & running
        done = infos["vehicle_done"] & acted
        ended = recorder.add(step, acted, rewards, infos["terms"], done, over, infos["arrivals"])
        step += 1
        found.trips += len(ended)
        found.arrived += int(ended["arrived"].sum())
        for trip in ended:
            for what in RECORDED:
                if trip[what]:
                    rows = before[trip["episode"]]
                    own = rows[rows["agent"] == trip["agent"]][0]
                    shared = what == "collision" and ground.holds(own, rows, vec.step_s)
                    named = "shared_ground" if shared else what
                    found.counts[named] += 1
                    found.faults.append(_place(vec, named, int(trip["episode"]), own, step))
        running &= ~over
        for number, row in watch.look(np.flatnonzero(running).tolist()):
            found.counts["stands"] += 1
            found.faults.append(_place(vec, "stands", number, row, step))
    return found


def _place(vec: CavVectorEnv, what: str, world: int, row: np.void, step: int) -> dict[str, Any]:
    return {
        "what": what.replace("_", " "),
        "world": world,
        "time_s": step * vec.step_s,
        "x": float(row["x"]),
        "y": float(row["y"]),
        "lane": vec.network.lane_ids[row["lane"]],
    }


class SharedGround:
    """Finds collisions between vehicles on overlapping lanes of different roads."""

    def __init__(self, network: RoadNetwork) -> None:
        self._network = network

    @cached_property
    def _pairs(self) -> frozenset[tuple[int, int]]:
        return frozenset(shared_ground(self._network))

    def holds(self, row: np.void, rows: NDArray[np.void], dt: float) -> bool:
        """Return whether the other vehicle of a contact is on a lane that overlaps this one's.

        The vehicle with the nearest axis is taken as the other one. `dt` is the upper bound of the
        time until they touch, in s. If no vehicle is near, the other one must have just departed on
        the overlapping lane, because departures on the same lane keep a distance. Inside a
        junction, a vehicle counts as on the lanes before and after it.
        """
        others = rows[rows["id"] != row["id"]]
        own_x, own_y = _axes(rows[rows["id"] == row["id"]], dt)
        x, y = _axes(others, dt)
        apart = np.hypot(x[:, :, None] - own_x, y[:, :, None] - own_y).min(axis=(1, 2))
        apart += np.where(np.abs(others["z"] - row["z"]) < LEVEL_M, 0.0, np.inf)
        lanes = self._connected(int(row["lane"]))
        if apart.min(initial=math.inf) > NEAR_AXIS_M:
            return any(lane in pair for lane in lanes for pair in self._pairs)
        beside = self._connected(int(others["lane"][apart.argmin()]))
        pairs = [(min(one, other), max(one, other)) for one in lanes for other in beside]
        return not self._pairs.isdisjoint(pairs)

    def _connected(self, lane: int) -> tuple[int, ...]:
        here = self._network.lanes[lane]
        if not here["internal"]:
            return (lane,)
        link = self._network.links[here["link"]]
        return int(link["from_lane"]), int(link["to_lane"])


def _axes(rows: NDArray[np.void], dt: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points from rear to front of vehicles after `dt`: (n, k) each."""
    inset = 0.5 * (rows["length"] - rows["width"])
    along = (rows["speed"] * dt)[:, None] + inset[:, None] * np.linspace(-1.0, 1.0, AXIS_PLACES)
    x = rows["x"][:, None] + np.cos(rows["heading"])[:, None] * along
    y = rows["y"][:, None] + np.sin(rows["heading"])[:, None] * along
    return x, y


class StandingVehicles:
    """Finds vehicles that have stood for `STANDS_S` without a cause, and reports each one once."""

    def __init__(self, vec: CavVectorEnv) -> None:
        self._vec = vec
        self._told: set[tuple[int, int]] = set()

    def look(self, worlds: Sequence[int]) -> Iterator[tuple[int, np.void]]:
        simulation = self._vec.simulation
        for world in worlds:
            rows = simulation.vehicles(world)
            long = np.flatnonzero(rows["wait_s"] >= STANDS_S)
            if not long.size:
                continue
            shown = signal_codes(self._vec.network, simulation.signal_phases(world))
            for i in long.tolist():
                key = (world, int(rows[i]["id"]))
                if key not in self._told and not self.has_cause(rows, i, shown):
                    self._told.add(key)
                    yield world, rows[i]

    def has_cause(self, rows: NDArray[np.void], i: int, shown: NDArray[np.uint8]) -> bool:
        """Return whether vehicle `i` has a cause to stand; `shown` has the signal of each link."""
        row = rows[i]
        others = rows[np.arange(len(rows)) != i]
        lane = self._vec.network.lanes[row["lane"]]
        inside = bool(lane["internal"])  # signals do not apply inside junctions
        step = self._vec.simulation.plans[row["goal"], row["lane"]]
        link = int(lane["link"] if inside else step["link"])
        along_x, along_y = math.cos(row["heading"]), math.sin(row["heading"])
        to_x, to_y = others["x"] - row["x"], others["y"] - row["y"]
        ahead = along_x * to_x + along_y * to_y > 0.0
        near = ahead & (np.hypot(to_x, to_y) < NEAR_AHEAD_M)
        if near.any() or (link >= 0 and not inside and shown[link] not in GREEN):
            return True
        return link >= 0 and self.gives_way(others, link)

    def gives_way(self, others: NDArray[np.void], link: int) -> bool:
        """Return whether there is no room behind a link, or another vehicle has priority."""
        network = self._vec.network
        lanes, target = network.lanes, network.links[link]
        if ((others["lane"] == target["to_lane"]) & (others["s"] < NEAR_AHEAD_M)).any():
            return True
        conflicts = network.conflicts[target["first_conflict"] :][: target["num_conflicts"]]
        # Only lanes inside junctions have a link.
        crosses = np.isin(lanes["link"][others["lane"]], conflicts["foe"])
        into = network.links["to_lane"][conflicts["foe"]]
        crosses |= np.isin(others["lane"], into) & (others["s"] < 0.5 * others["length"])
        first = network.links["from_lane"][conflicts["foe"][conflicts["must_yield"]]]
        to_line = lanes["length_m"][others["lane"]] - others["s"]
        announced = np.array([registration_distance_m(speed) for speed in others["speed"].tolist()])
        comes = np.isin(others["lane"], first) & (to_line < announced)
        return bool((crosses | comes).any())


if __name__ == "__main__":
    run(measure)
