"""Runs of evacuations: the environment that follows from a plan, and what a run shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from cavmarl.config.registry import entries, load_config, resolve_map
from cavmarl.config.road_events import RoadEvent
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import load_world
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.evaluate.evacuation.evacuation_demand import Evacuees, find_evacuees
from cavmarl.evaluate.evacuation.evacuation_plan import EvacuationPlan, default_exits, edge_rows
from cavmarl.maps.netconvert import map_file
from cavmarl.roads.contraflow_ids import contraflow_of
from cavmarl.roads.network import RoadNetwork

STEP_S = 1.0
TICK_S = 0.1
STANDING_MPS = 0.5
SHARES = (0.5, 0.9, 1.0)  # shares of an area's vehicles, for the clearance times
RECOVERED_SHARE = 1.1  # most stopped vehicles after recovery, as a share of those before closure
ENTRY, DEMAND = "env.yaml", "demand.rou.xml"
Told = Callable[[int, int], None]


@dataclass(frozen=True)
class PreparedEvacuation:
    """An evacuation with its environment on disk."""

    plan: EvacuationPlan
    exits: tuple[str, ...]
    network: RoadNetwork
    evacuees: Evacuees
    folder: Path  # folder of the environment


@dataclass(frozen=True)
class AreaResult:
    """The result of one area; times are in s after the order, None: that did not happen."""

    vehicles: int
    departed: int
    arrived: int
    unserved: int  # vehicles that have not reached an exit, including those unable to depart
    clearance_50_s: float | None  # time at which half of the vehicles have reached an exit
    clearance_90_s: float | None  # the same for 90 % of the vehicles
    clearance_s: float | None  # the same for all vehicles
    last_arrival_s: float | None  # last arrival at an exit
    mean_trip_s: float | None  # from the planned departure to the exit
    left_by_s: float | None  # time at which the last vehicle was seen on a road of the area


@dataclass(frozen=True)
class EvacuationResult:
    """The result of one run."""

    seed: int
    areas: dict[str, AreaResult]
    all: AreaResult
    exits: dict[str, int]  # arrivals at each exit
    longest_queue: int  # largest number of vehicles stopped at the same time
    mean_queue: float  # mean number of stopped vehicles over the samples
    queues: dict[str, int]  # longest queues: largest number of stopped vehicles by road
    # time in s from the last opening of a road until the number of stopped vehicles is about as
    # low as before the first closure; None: no closure ended, or traffic did not recover
    recovery_s: float | None
    deadlocks: tuple[tuple[int, ...], ...]  # ids of vehicles that wait for each other at the end
    rerouted: int  # changes of route; one vehicle may count several times
    contacts: int  # number of vehicles that began to touch another vehicle
    # roads and junctions with most contacts → vehicles in contact, summed over the samples
    contact_places: dict[str, int]
    contraflow: dict[str, int]  # vehicles of the areas that used the contraflow lanes of each road
    state_hash: str
    series: dict[str, list[float]]  # values per second: time_s, departed, arrived, standing

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def prepare(plan: EvacuationPlan, base: Path, folder: Path, seed: int) -> PreparedEvacuation:
    """Write the environment of a plan to a folder: `env.yaml` and a demand file.

    Args:
        plan: the plan.
        base: folder that a relative path of the map refers to.
        folder: folder of the environment, which exists.
        seed: seed of the order of departures.

    Raises:
        ConfigError: the plan does not fit the map.
        MapError: the map cannot be read.
    """
    source = _map_of(plan.map, base)
    # The network without contraflow lanes has all roads that the plan names.
    network = load_world(source, agents=0, background=0).network
    edge_rows(plan.contraflow, "contraflow", network)
    exits = plan.exits or default_exits(plan, network)
    evacuees = find_evacuees(plan, exits, network, seed)
    demand = folder / DEMAND
    demand.write_text(evacuees.to_xml(plan, network), encoding="utf-8")
    reversals = [
        {"at_s": plan.start_s, "action": "reverse", "edges": [road], "shuts_in": True}
        for road in plan.contraflow
    ]
    document = {
        "name": folder.name,
        "version": 1,
        "map": {
            "source": str(source),
            "contraflow": list(plan.contraflow),
            "changed_lanes": _changed_lanes(plan, network),
            "events": [*reversals, *map(_event_keys, plan.events)],
        },
        "clock": {"sim_dt_s": TICK_S, "ctrl_dt_s": STEP_S},
        "population": {
            "mode": "respawn",
            "agents": 0,
            "background": plan.background,
            "reroute": "blocked",
        },
        "traffic": {"demand": [DEMAND]},
        "horizon_s": plan.horizon_s + STEP_S,  # so that no world resets in the last step
    }
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    (folder / ENTRY).write_text(text, encoding="utf-8")
    return PreparedEvacuation(plan, exits, network, evacuees, folder)


def _map_of(name: str, base: Path) -> Path:
    """Return the SUMO network of a plan's map."""
    if name in entries():
        return map_file(resolve_map(*load_config(name))).resolve()
    path = base / name
    if not path.is_file():
        raise ConfigError(f"map = {name!r}: there is no file {path} and no such environment")
    return map_file(path).resolve()


def _event_keys(event: RoadEvent) -> dict[str, Any]:
    found = {key: value for key, value in asdict(event).items() if value is not None}
    return found | {key: list(found[key]) for key in ("edges", "lanes") if key in found}


def _changed_lanes(plan: EvacuationPlan, network: RoadNetwork) -> int:
    """Return how many lanes may differ from the map at the same time."""
    lanes = network.edges["num_lanes"]
    twice = 2 * int(lanes[edge_rows(plan.contraflow, "contraflow", network)].sum())
    named = {edge for event in plan.events for edge in event.edges}
    rows = edge_rows(sorted(named), "events", network) if named else np.zeros(0, dtype=np.intp)
    return max(1, twice + int(lanes[rows].sum()))


def run_evacuation(
    prepared: PreparedEvacuation,
    *,
    seed: int = 0,
    zones: int | None = None,
    backend: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    told: Told = lambda arrived, vehicles: None,
) -> EvacuationResult:
    """Run an evacuation to its horizon, or until all vehicles have reached an exit.

    Args:
        prepared: the evacuation.
        seed: seed of the world.
        zones: see `make_vec`; results do not depend on it.
        backend: see `make_vec`; results do not depend on it.
        overrides: values of further keys.
        told: called every second with the number of arrivals and the number of all vehicles.

    Raises the errors of `make_vec`.
    """
    vec = make_vec(
        prepared.folder, num_envs=1, zones=zones, backend=backend, seed=seed, overrides=overrides
    )
    try:
        return _run(prepared, vec, seed, told)
    finally:
        vec.close()


def _run(
    prepared: PreparedEvacuation, vec: CavVectorEnv, seed: int, told: Told
) -> EvacuationResult:
    meter = _Meter(prepared, vec)
    vec.reset(seed=seed)
    idle = vec.suggest_actions()
    meter.sample(0.0, vec.present.vehicles(0))
    for second in range(1, int(prepared.plan.horizon_s / STEP_S) + 1):
        vec.step(idle)
        meter.sample(second * STEP_S, vec.present.vehicles(0))
        told(meter.arrived, len(prepared.evacuees.area))
        if meter.is_over:
            break
    return meter.result(vec, seed)


class _Meter:
    """Measurements of a run, taken every second."""

    def __init__(self, prepared: PreparedEvacuation, vec: CavVectorEnv) -> None:
        self._plan, self._exits, self._ids = (
            prepared.plan,
            prepared.exits,
            prepared.network.edge_ids,
        )
        self._evacuees, self._network = prepared.evacuees, vec.network
        count = len(self._evacuees.area)
        self._departed_s = np.full(count, np.nan)
        self._arrived_s = np.full(count, np.nan)
        self._seen_s = np.full(len(self._plan.areas), np.nan)
        names = {name: row for row, name in enumerate(vec.network.edge_ids)}
        self._home = [
            np.array([names[self._ids[edge]] for edge in np.unique(self._of_area(k)).tolist()])
            for k in range(len(self._plan.areas))
        ]
        self._back = {road: names[contraflow_of(road)] for road in self._plan.contraflow}
        self._used = {road: np.zeros(count, dtype=np.bool_) for road in self._back}
        self._touching = np.zeros(len(vec.network.edges), dtype=np.int64)
        self._most_queued = np.zeros(len(vec.network.edges), dtype=np.int64)
        self._time_s: list[float] = []
        self._standing: list[int] = []
        self._counts: list[tuple[int, int]] = []

    def _of_area(self, number: int) -> NDArray[np.int64]:
        found: NDArray[np.int64] = self._evacuees.edge[self._evacuees.area == number]
        return found

    @property
    def departed(self) -> int:
        """Number of vehicles that have departed."""
        return int(np.isfinite(self._departed_s).sum())

    @property
    def arrived(self) -> int:
        """Number of vehicles that have reached an exit."""
        return int(np.isfinite(self._arrived_s).sum())

    @property
    def is_over(self) -> bool:
        """Whether all vehicles have arrived, and all events have happened."""
        is_last = all(event.at_s < self._time_s[-1] for event in self._plan.events)
        return self.arrived == len(self._arrived_s) and is_last and self._recovered()

    def _recovered(self) -> bool:
        return not self._closures() or self._recovery_s() is not None

    def sample(self, time_s: float, rows: NDArray[np.void]) -> None:
        """Record which vehicles drive and where vehicles are stopped; `rows`: VEHICLE (n,)."""
        there = np.zeros(len(self._departed_s), dtype=np.bool_)
        evacuees = rows[rows["order"] >= 0]
        there[evacuees["order"]] = True
        is_new = there & np.isnan(self._departed_s)
        self._departed_s[is_new] = time_s
        has_left = ~there & np.isfinite(self._departed_s) & np.isnan(self._arrived_s)
        self._arrived_s[has_left] = time_s
        edges = self._network.lanes["edge"][evacuees["lane"]]
        for number, home in enumerate(self._home):
            if np.isin(edges, home).any():
                self._seen_s[number] = time_s
        for road, back in self._back.items():
            self._used[road][evacuees["order"][edges == back]] = True
        stands = np.abs(rows["speed"]) < STANDING_MPS
        queued = np.bincount(
            self._network.lanes["edge"][rows["lane"][stands]], minlength=len(self._most_queued)
        )
        np.maximum(self._most_queued, queued, out=self._most_queued)
        touches = self._network.lanes["edge"][rows["lane"][rows["hit"] >= 0]]
        self._touching += np.bincount(touches, minlength=len(self._touching))
        self._time_s.append(time_s)
        self._standing.append(int(stands.sum()))
        self._counts.append((self.departed, self.arrived))

    def _closures(self) -> list[RoadEvent]:
        """Return the events that close roads, if a later event opens roads again."""
        events = self._plan.events
        opens = [event.at_s for event in events if event.action == "open"]
        return [
            event
            for event in events
            if event.action == "close" and opens and event.at_s < max(opens)
        ]

    def _recovery_s(self) -> float | None:
        """Return the time from the last opening until queues are short again; None: not yet."""
        closures = self._closures()
        if not closures:
            return None
        opened_s = max(event.at_s for event in self._plan.events if event.action == "open")
        closed_s = min(event.at_s for event in closures)
        time_s, standing = np.array(self._time_s), np.array(self._standing)
        before = standing[time_s <= closed_s]
        wanted = max(1.0, RECOVERED_SHARE * float(before[-60:].mean()))
        after = (time_s >= opened_s) & (standing <= wanted)
        return float(time_s[after.argmax()] - opened_s) if after.any() else None

    def _area(self, chosen: NDArray[np.bool_], seen_s: float) -> AreaResult:
        start_s = self._plan.start_s
        departed, arrived = self._departed_s[chosen], self._arrived_s[chosen]
        came = np.sort(arrived[np.isfinite(arrived)])
        number = len(arrived)
        cleared = [
            float(came[int(np.ceil(share * number)) - 1] - start_s)
            if len(came) >= np.ceil(share * number)
            else None
            for share in SHARES
        ]
        trips = (arrived - self._evacuees.depart_s[chosen])[np.isfinite(arrived)]
        return AreaResult(
            vehicles=number,
            departed=int(np.isfinite(departed).sum()),
            arrived=len(came),
            unserved=number - len(came),
            clearance_50_s=cleared[0],
            clearance_90_s=cleared[1],
            clearance_s=cleared[2],
            last_arrival_s=float(came[-1] - start_s) if len(came) else None,
            mean_trip_s=float(trips.mean()) if len(trips) else None,
            left_by_s=None if np.isnan(seen_s) else float(seen_s - start_s),
        )

    def _arrivals(self) -> dict[str, int]:
        """Return the number of arrivals at each exit."""
        goals = self._evacuees.exit[np.isfinite(self._arrived_s)]
        return {name: int((goals == self._ids.index(name)).sum()) for name in self._exits}

    def result(self, vec: CavVectorEnv, seed: int) -> EvacuationResult:
        """Return the figures of the run so far."""
        evacuees, ids = self._evacuees, self._network.edge_ids
        everyone = np.ones(len(evacuees.area), dtype=np.bool_)
        last_seen_s = float(np.nanmax(self._seen_s)) if np.isfinite(self._seen_s).any() else np.nan
        stats = vec.traffic_stats()
        departed, arrived = zip(*self._counts, strict=True)
        return EvacuationResult(
            seed=seed,
            areas={
                name: self._area(evacuees.area == number, float(self._seen_s[number]))
                for number, name in enumerate(self._plan.areas)
            },
            all=self._area(everyone, last_seen_s),
            exits=self._arrivals(),
            longest_queue=max(self._standing),
            mean_queue=float(np.mean(self._standing)),
            queues=_largest(self._most_queued, ids),
            recovery_s=self._recovery_s(),
            deadlocks=vec.deadlocks(),
            rerouted=int(stats["rerouted"]),
            contacts=int(stats["contacts"]),
            contact_places=_largest(self._touching, ids),
            contraflow={road: int(used.sum()) for road, used in self._used.items()},
            state_hash=vec.state_hash(),
            series={
                "time_s": self._time_s,
                "departed": [float(number) for number in departed],
                "arrived": [float(number) for number in arrived],
                "standing": [float(number) for number in self._standing],
            },
        )


def _largest(numbers: NDArray[np.int64], ids: Sequence[str]) -> dict[str, int]:
    """Return the ten largest numbers (num_edges,) above 0 by the ids of edges."""
    rows = np.argsort(-numbers, kind="stable")[:10].tolist()
    return {ids[row]: int(numbers[row]) for row in rows if numbers[row] > 0}
