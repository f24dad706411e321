"""The seeded traffic generator: possible trips, and tables from which departures are drawn."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.action import ActionConfig
from cavmarl.config.population import PopulationConfig
from cavmarl.config.traffic import ZOO, TrafficConfig
from cavmarl.core.compiled.bound_call import bound, keep_last
from cavmarl.core.errors import CapacityError
from cavmarl.core.memory import Zeros
from cavmarl.core.records.arrays import (
    Demand,
    DepartureQueue,
    RoadArrays,
    Scripts,
    TripTables,
    Worlds,
)
from cavmarl.core.records.codes import MODEL_IDM
from cavmarl.driving.driver_models import model_code
from cavmarl.driving.kernels.drivers import look_ahead_m, see_line_m
from cavmarl.driving.kernels.lanes.lane_index import VIEW_M
from cavmarl.driving.vehicle_types import agent_types, generated_types, names_beside_car
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import PLAN, make_plans
from cavmarl.traffic.demand import STOP, DemandFile
from cavmarl.traffic.departure_queue import with_room
from cavmarl.traffic.kernels import admission, demand_generator
from cavmarl.traffic.kernels.demand_generator import END_ROOM_M, PLACE_GAP_M, populate
from cavmarl.traffic.lane_plans import LanePlans
from cavmarl.traffic.map_trips import MapTrips, for_each_map, together
from cavmarl.traffic.rerouting import Rerouting
from cavmarl.traffic.scenarios.cast import Cast
from cavmarl.traffic.scenarios.logged_traffic import logged_commands
from cavmarl.traffic.scenarios.movement_scripts import NO_SCRIPTS
from cavmarl.traffic.scenarios.scene import Scene
from cavmarl.traffic.schedule import Schedule
from cavmarl.traffic.sumo.route_book import RouteBook, StopBook
from cavmarl.traffic.sumo.sumo_demand import SumoDemand
from cavmarl.traffic.turning_circle import TurningBody, with_tight_turns
from cavmarl.traffic.way_search import WaySlots, seekers, way_slots

FAST_FACTOR = 1.5  # speed divided by the limit; few drivers of demand files want to drive faster
JAM_GAP_M = 2.5  # m between the bumpers of queued vehicles
PLACED_SHARE = 0.75  # share of the origin lanes that placed agents may occupy; the rest stays free


class TrafficCalls:
    """The kernel calls for the departures of some worlds, with their arguments.

    Attributes:
        running: (W,) vehicles of each world in all zones; read by `accept`.
        inserted: (W, I, 3) vehicles to insert; read by `insert`, see `Commands`.
    """

    def __init__(
        self,
        traffic: NativeTraffic,
        departures: DepartureQueue,
        ticks: NDArray[np.int64],  # (W,) tick of each world
        keys: NDArray[np.uint64],  # (W,) random key of each world
        lanes: NDArray[np.void],  # LANE (V, L), see `Worlds`
    ) -> None:
        self._traffic = traffic
        self._departures = departures
        self._ticks = ticks
        self._keys = keys
        self._lanes = lanes
        self.running = np.zeros(len(ticks), dtype=np.int64)
        self.inserted = np.zeros((len(ticks), traffic.population.insertions, 3))

    @property
    def values(self) -> dict[str, Any]:
        """The arguments of the kernels by the names of their parameters."""
        traffic = self._traffic
        return {
            "demand": traffic.demand,
            "roads": traffic.network.arrays,
            "travel": traffic.travel,
            "departures": self._departures,
            "ticks": self._ticks,
            "keys": self._keys,
            "lanes": self._lanes,
            "dt": traffic.dt,
            "num_goals": len(traffic.plans),
            "inserted": self.inserted,
            "running": self.running,
            "capacity": traffic.capacity,
        }

    call_orders = bound(demand_generator.call_orders)
    settle = bound(demand_generator.settle)
    insert = bound(demand_generator.insert)
    assign_lanes = bound(admission.assign_lanes)
    accept = bound(admission.accept)


@dataclass(frozen=True)
class NativeTraffic:
    """The departures of one population on the maps of a network."""

    network: RoadNetwork
    traffic: TrafficConfig  # settings of the generator
    population: PopulationConfig  # the kinds of vehicles in the world
    blank: NDArray[np.void]  # VEHICLE (1,), template of every vehicle's record
    dt: float
    horizon_s: float  # length of an episode in s
    file: DemandFile | None = None  # demand in addition to generated vehicles
    num_worlds: int = 1
    # allocates the table of steps if vehicles search for routes while the world runs
    zeros: Zeros = np.zeros
    scene: Scene | None = None  # the scenario that is played in each world
    sumo: SumoDemand | None = None  # vehicles that SUMO runs; excludes `file`
    lane_changes: bool = False  # whether lanes of a world may differ from the map

    def __post_init__(self) -> None:
        # Refuse impossible trips when the world is made, not at its first reset.
        _ = self.demand
        self._check_room()

    def for_worlds(self, num_worlds: int) -> NativeTraffic:
        """Return a copy for another number of worlds, with the same shared tables."""
        other = copy(self)
        object.__setattr__(other, "num_worlds", num_worlds)
        for name in (
            "travel",
            "_travel_of_others",
            "slots",
            "rerouting",
            "calls",
            "lane_plans",
            "changed_at",
        ):  # these depend on the number of worlds
            vars(other).pop(name, None)
        other._check_room()
        return other

    @cached_property
    def goal_edges(self) -> NDArray[np.int32]:
        """EDGE rows (M, G) of each map's goals; a map with fewer goals repeats some."""
        acted = [] if self.scene is None else self.scene.goal_edges
        found = for_each_map(self.network, lambda number: self.trips_of(number).goals(acted))
        most = max(map(len, found))
        return np.array([np.resize(goals, most) for goals in found], dtype=np.int32)

    @cached_property
    def plans(self) -> NDArray[np.void]:
        """PLAN (G, L): for each goal, the route from each lane of the same map."""
        roads = self._plan_roads
        maps = self.network.maps
        if len(maps) == 1:
            return make_plans(self.network, self.goal_edges[0].tolist(), roads=roads)
        plans = np.zeros((self.goal_edges.shape[1], len(self.network.lanes)), dtype=PLAN)
        for row, goals in zip(maps, self.goal_edges.tolist(), strict=True):
            own = slice(row["first_lane"], row["first_lane"] + row["num_lanes"])
            plans[:, own] = make_plans(self.network, goals, roads=roads)[:, own]
        plans.setflags(write=False)
        return plans

    @cached_property
    def _plan_roads(self) -> RoadArrays:
        """The roads without turns that are too tight for one of the agents' types."""
        names = dict.fromkeys(self.population.agent_types)
        bodies = tuple(
            TurningBody(*(float(kind[name]) for name in TurningBody._fields))
            for kind in agent_types(names, own=self.population.own_types)
        )
        return with_tight_turns(self.network, ActionConfig().steering_rad, bodies)

    def trips_of(self, number: int) -> MapTrips:
        """Return the trips of one map."""
        return MapTrips(self.network, number, self.traffic)

    @cached_property
    def schedule(self) -> Schedule | None:
        """The demand file's departures and routes."""
        if self.file is None:
            return None
        return Schedule(self.file, len(self.own_types), self.plans.size)

    @cached_property
    def cast(self) -> Cast | None:
        if self.scene is None:
            return None
        files = self.file if self.sumo is None else self.sumo
        first_type = len(self.own_types) + (0 if files is None else len(files.types))
        goals = {edge: goal for goal, edge in enumerate(self.goal_edges[0].tolist())}
        agents = self.population.agents
        return Cast.of(self.scene, self.network, goals, first_type, self.dt, agents)

    @cached_property
    def _model_codes(self) -> tuple[int, ...]:
        """MODEL_* of the generator's car-following models; IDM if networks drive all vehicles."""
        names = [name for name in self.traffic.models if not name.startswith(ZOO)]
        return tuple(dict.fromkeys(model_code(name) for name in names)) or (MODEL_IDM,)

    @cached_property
    def own_types(self) -> NDArray[np.void]:
        """VTYPE rows of generated cars: one for each driver model, then one for each network.

        The first row, with the car-following model of the largest share, is also the agents' car.
        """
        codes = self._model_codes
        networks = len(self.traffic.networks)
        types = np.concatenate(
            [generated_types(code) for code in codes] + [generated_types(codes[0])] * networks
        )
        types["network"][len(codes) :] = np.arange(networks) + 1
        types.setflags(write=False)
        return types

    @cached_property
    def _drawn_types(self) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """The rows of `own_types` from which vehicles are drawn, and their cumulative shares."""
        codes, networks = self._model_codes, self.traffic.networks
        rows = [
            len(codes) + networks.index(name.removeprefix(ZOO))
            if name.startswith(ZOO)
            else codes.index(model_code(name))
            for name in self.traffic.models
        ]
        ends = np.cumsum(list(self.traffic.models.values()))
        return np.array(rows, dtype=np.int32), ends / ends[-1]

    @cached_property
    def travel(self) -> TripTables:
        """Types and routes of all vehicles: generated, from the demand file, actors and agents.

        Most agents drive a car, which is a generated type.
        """
        more = agent_types(self._other_types, self._model_codes[0], self.population.own_types)
        found = self._travel_of_others
        found = found._replace(trip_horizon=self.traffic.trip_horizon, tick_s=self.dt)
        return found._replace(types=np.concatenate([found.types, more])) if len(more) else found

    @property
    def num_replayed(self) -> int:
        """Number of replayed road users of a logged scene."""
        return 0 if self.scene is None or self.scene.log is None else len(self.scene.log.replayed)

    @property
    def num_external(self) -> int:
        """Number of slots of posed vehicles: the caller's, then replayed, then SUMO's persons."""
        return self.population.external + self.num_replayed + self.num_persons

    @property
    def num_persons(self) -> int:
        """Number of mirrored persons of SUMO."""
        return 0 if self.sumo is None else self.sumo.num_persons

    @property
    def _other_types(self) -> list[str]:
        """Names of the types of agents' and of the caller's vehicles, without the car."""
        return names_beside_car(self.population, self.num_external > 0)

    @cached_property
    def type_rows(self) -> dict[str, int]:
        """VTYPE rows of the types of agents' and of the caller's vehicles, by name."""
        first = len(self.travel.types) - len(self._other_types)
        return {"car": 0} | {name: first + k for k, name in enumerate(self._other_types)}

    @cached_property
    def _agent_type_rows(self) -> NDArray[np.int32]:
        """VTYPE rows of the agents' types, which agents use in turn by their number."""
        rows = self.type_rows
        return np.array([rows[name] for name in self.population.agent_types], dtype=np.int32)

    @cached_property
    def _travel_of_others(self) -> TripTables:
        types = self.own_types
        steps = self.plans.reshape(-1)
        nowhere = self._nowhere_steps
        scripts = NO_SCRIPTS if self.cast is None else self.cast.scripts
        actors = types[:0] if self.cast is None else self.cast.types
        if self.sumo is not None:
            types = np.concatenate([types, self.sumo.types, actors])
            return self._travel_of_sumo(self.sumo, types, np.concatenate([steps, nowhere]), scripts)
        if self.file is None or self.schedule is None:
            types = np.concatenate([types, actors])
            steps = np.concatenate([steps, nowhere]) if len(nowhere) else steps
            stops, num_fixed = np.zeros(0, dtype=STOP), len(steps)
            steps, shifts = self._with_room(steps), self._shifts
            return TripTables(
                types, steps, stops, 0, 0.0, VIEW_M, VIEW_M, num_fixed, scripts, shifts
            )
        types = np.concatenate([types, self.file.types, actors])
        steps = np.concatenate([steps, self.schedule.steps, nowhere])
        num_fixed = len(steps)
        steps = self._with_room(steps)
        first_detour = self.plans.size + self.schedule.first_detour
        begin_s = self.file.begin_ms / 1000.0
        return TripTables(
            types,
            steps,
            self.file.stops,
            first_detour,
            begin_s,
            view_m=self._farthest_m(look_ahead_m),
            see_m=self._farthest_m(_centre_sees_line_m),
            num_fixed=num_fixed,
            scripts=scripts,
            shifts=self._shifts,
        )

    @property
    def nowhere(self) -> int:
        """VEHICLE["way"] of vehicles that are posed or driven by the caller: it leads nowhere."""
        return self.plans.size + (0 if self.schedule is None else len(self.schedule.steps))

    @property
    def _nowhere_steps(self) -> NDArray[np.void]:
        """PLAN (L,) in which each step ends the route; empty without posed vehicles."""
        steps = np.zeros(len(self.network.lanes) if self.num_external else 0, dtype=PLAN)
        steps["next"] = steps["link"] = -1
        steps["to_go"] = np.inf
        return steps

    @property
    def _shifts(self) -> NDArray[np.int64]:
        return self.zeros(self.num_worlds, dtype=np.int64)

    @property
    def _first_own(self) -> int:
        """Row of the first step that the world writes while it runs."""
        return self.nowhere + len(self._nowhere_steps)

    @property
    def _own_steps(self) -> int:
        """Number of steps of the plans of all worlds; 0 if no world has its own plans."""
        changes = self.lane_changes and self.population.reroute != "never"
        return (1 + self.num_worlds) * self.plans.size if changes else 0

    @property
    def own_plan_steps(self) -> range:
        """Rows of the steps of the worlds' own plans; SUMO's routes come after them."""
        return range(self._first_own, self._first_own + self._own_steps)

    def _with_room(self, fixed: NDArray[np.void]) -> NDArray[np.void]:
        """Return the table of steps, with room for routes found at run time."""
        more = self._own_steps + (0 if self.slots is None else self.slots.room)
        if not more:
            return fixed
        steps = self.zeros(len(fixed) + more, dtype=fixed.dtype)
        steps[: len(fixed)] = fixed
        return steps

    @cached_property
    def lane_plans(self) -> LanePlans | None:
        """The plans of worlds whose lanes may differ from the map; None: no such worlds."""
        if not self._own_steps:
            return None
        first, shape = self._first_own, (1 + self.num_worlds, *self.plans.shape)
        own = self.travel.steps[first : first + self._own_steps].reshape(shape)
        own[:] = self.plans
        follows = self.population.reroute == "always"
        roads, goals = self._plan_roads, self.goal_edges[0]
        return LanePlans(roads, goals, self.plans, own, self.travel.shifts, first, follows)

    @cached_property
    def changed_at(self) -> NDArray[np.int64]:
        """(W,) tick in which the lanes of each world last changed; -1: never."""
        ticks: NDArray[np.int64] = self.zeros(self.num_worlds, dtype=np.int64)
        ticks[:] = -1
        return ticks

    @property
    def owns_ways(self) -> bool:
        """Whether each world writes its own routes while it runs."""
        return self.rerouting is not None or self._own_steps > 0

    def moved_ways(self, ways: NDArray[np.int64], worlds: int) -> NDArray[np.int64]:
        """Convert VEHICLE["way"] (n,) of world w to the values in world w + `worlds`."""
        first = self._first_own
        is_plan = (ways >= first) & (ways < first + self._own_steps)
        moved: NDArray[np.int64] = ways + is_plan * (worlds * self.plans.size)
        if self.slots is None:
            return moved
        return np.where(is_plan, moved, self.slots.ways_of_first_world(ways, -worlds))

    @property
    def plans_now(self) -> NDArray[np.void]:
        """PLAN (V, G, L): the plans on the map and, if lanes may change, each world's plans."""
        return self.plans[np.newaxis] if self.lane_plans is None else self.lane_plans.tables

    def _travel_of_sumo(
        self,
        sumo: SumoDemand,
        types: NDArray[np.void],
        fixed: NDArray[np.void],
        scripts: Scripts,
    ) -> TripTables:
        """Return the tables with room for the plans of each world, and SUMO's routes and stops."""
        room = self._own_steps + RouteBook.room(self.network, self.num_worlds)
        steps = self.zeros(len(fixed) + room, dtype=fixed.dtype)
        steps[: len(fixed)] = fixed
        stops = self.zeros(0 if sumo.drives else StopBook.room(self.num_worlds), dtype=STOP)
        return TripTables(
            types,
            steps,
            stops,
            0,
            sumo.given.begin_s,
            VIEW_M,
            VIEW_M,
            num_fixed=len(fixed),
            scripts=scripts,
            shifts=self._shifts,
        )

    def _farthest_m(self, look_m: Callable[[np.void, float], float]) -> float:
        """Return the largest distance that any driver looks ahead, in m.

        If all drivers brake as in SUMO, the fastest driver determines the distance. Otherwise it is
        `VIEW_M`: IDM reacts to any leader, and agents may drive at any speed.
        """
        own = self.population
        if self.file is None or _own_vehicles(own) > 0:
            return VIEW_M
        fast_mps = FAST_FACTOR * float(self.network.lanes["speed_mps"].max())
        looks_m = [
            VIEW_M
            if not kind["as_sumo"]
            else min(look_m(kind, min(fast_mps, float(kind["max_speed"]))), VIEW_M)
            for kind in self.file.types
        ]
        return max(looks_m, default=VIEW_M)  # a demand file may have no vehicles

    @cached_property
    def slots(self) -> WaySlots | None:
        """Room for routes found at run time; None if no vehicle reroutes."""
        schedule = self.schedule
        if schedule is None or not self._reroutes:
            return None
        if self._own_steps:
            number = self.capacity
        else:
            number = seekers(schedule, self.capacity, self.horizon_s)
        if number == 0:
            return None
        first_step = self._first_own + self._own_steps
        return way_slots(self.network.lanes, schedule.longest, first_step, self.num_worlds, number)

    @property
    def _reroutes(self) -> bool:
        """Return whether the demand has rerouters, or vehicles that search for routes."""
        file = self.file
        searches = file is not None and (file.may_look or len(file.rerouters.rules) > 0)
        return searches or self._own_steps > 0

    @property
    def ticks_per_s(self) -> int:
        """Number of ticks per second; at least 1."""
        return max(1, round(1.0 / self.dt))

    @cached_property
    def rerouting(self) -> Rerouting | None:
        """The rerouting of vehicles; None if vehicles do not reroute."""
        if self.schedule is None or self.slots is None:
            return None
        first_type = len(self.own_types)
        avoids = self.population.reroute if self.lane_changes else "never"
        return Rerouting(
            self.schedule,
            self.travel,
            self.slots,
            first_type,
            self.dt,
            changed_at=self.changed_at,
            avoids=avoids,
        )

    @cached_property
    def capacity(self) -> int:
        """Number of vehicle rows that one world needs."""
        actors = 0 if self.scene is None else self.scene.num_rows
        if self.sumo is not None:
            return _capacity_of_sumo(self.population, self.sumo) + actors
        args = (self.network, self.population, self.schedule, self.dt, self.horizon_s)
        return _capacity(*args) + actors

    @cached_property
    def demand(self) -> Demand:
        """The tables from which departures are drawn.

        Raises ConfigError: no trip on a map has a length within the configured limits.
        """
        num_goals = self.goal_edges.shape[1]
        parts = for_each_map(
            self.network, lambda number: self.trips_of(number).drawn(self.plans, num_goals)
        )
        return Demand(
            agent_trips=together([part.agent_arrays for part in parts]),
            start_trips=together([part.at_start for part in parts]),
            enter_trips=together([part.entering for part in parts]),
            enter_at_start=np.array([part.has_ways_in for part in parts]),
            num_agents=self.population.agents,
            num_ids=self.population.num_ids,
            num_background=self.population.background,
            reenter=self.population.mode != "closed",
            endless=self.traffic.endless,
            seats=self.population.mode == "respawn",
            speed_factor_spread=self.traffic.speed_factor_spread,
            blank=self.blank,
            agent_types=self._agent_type_rows,
            drawn_types=self._drawn_types[0],
            drawn_ends=self._drawn_types[1],
        )

    def draw_orders(
        self, departures: DepartureQueue, worlds: Worlds, chosen: NDArray[np.bool_]
    ) -> DepartureQueue:
        """Draw the orders of the demand file for new episodes of the `chosen` worlds (W,).

        Return the departure queue, enlarged if it had too little room for the orders.
        """
        if self.schedule is None:
            return departures
        for w in np.flatnonzero(chosen):
            orders = self.schedule.draw(int(worlds.keys[w]), self.horizon_s, self.dt)
            departures = with_room(departures, len(orders))
            departures.orders[w, : len(orders)] = orders
            departures.num_orders[w] = len(orders)
            if self.rerouting is not None:
                self.rerouting.begin(int(w), int(worlds.keys[w]), self.horizon_s)
        return departures

    def num_orders(self, key: int) -> int:
        """Return how many departures the demand file orders in the episode with this key."""
        if self.schedule is None:
            return 0
        return self.schedule.count(key, self.horizon_s)

    def populate(
        self, departures: DepartureQueue, worlds: Worlds, chosen: NDArray[np.bool_]
    ) -> None:
        """Fill the `chosen` worlds (W,) for a new episode."""
        if self.lane_plans is not None:
            for w in np.flatnonzero(chosen).tolist():
                self.lane_plans.renew(w, self.network.arrays.lanes)
        populate(self.demand, self.network.arrays, self.travel, departures, worlds, chosen)
        worlds.cues[chosen] = -1
        if self.cast is not None:
            for w in np.flatnonzero(chosen).tolist():
                entered = self.network.arrays, self.travel, departures, worlds, w, self.blank
                self.cast.enter(*entered)
                if self.cast.scene.log is not None:
                    first = self.population.external
                    self.cast.enter_logged(*entered, first, self.at_reset, self.nowhere)

    @cached_property
    def at_reset(self) -> NDArray[np.void]:
        """EXTERNAL (L,) of the replayed road users at the reset; EXTERNAL_REMOVED if absent."""
        log = None if self.scene is None else self.scene.log
        commands: NDArray[np.void] = logged_commands(log, self.type_rows, self.dt)[0]
        return commands

    def settle(self, departures: DepartureQueue, worlds: Worlds) -> None:
        """Count vehicles that have left, and order replacements."""
        self.calls(departures, worlds.ticks, worlds.keys, worlds.lanes).settle()

    def assign_lanes(self, departures: DepartureQueue, worlds: Worlds) -> None:
        """Assign to each queued vehicle the lane on which it tries to enter."""
        self.calls(departures, worlds.ticks, worlds.keys, worlds.lanes).assign_lanes()

    def call_orders(self, departures: DepartureQueue, worlds: Worlds) -> None:
        """Move orders that are due by the coming tick into the queue."""
        if departures.next_order.tolist() != departures.num_orders.tolist():
            self.calls(departures, worlds.ticks, worlds.keys, worlds.lanes).call_orders()

    def insert(
        self, departures: DepartureQueue, worlds: Worlds, inserted: NDArray[np.float64]
    ) -> None:
        """Queue the vehicles to insert in this step; `inserted`: see `Commands`."""
        calls = self.calls(departures, worlds.ticks, worlds.keys, worlds.lanes)
        np.copyto(calls.inserted, inserted)
        calls.insert()

    def accept(
        self, departures: DepartureQueue, worlds: Worlds, running: NDArray[np.int64]
    ) -> None:
        """Choose which vehicles enter; `running` (W,): vehicles already in each world."""
        calls = self.calls(departures, worlds.ticks, worlds.keys, worlds.lanes)
        np.copyto(calls.running, running)
        calls.accept()

    @cached_property
    def calls(
        self,
    ) -> Callable[
        [DepartureQueue, NDArray[np.int64], NDArray[np.uint64], NDArray[np.void]], TrafficCalls
    ]:
        """Return the kernel calls for a departure queue and its worlds' ticks, keys and lanes."""
        return keep_last(partial(TrafficCalls, self))

    @property
    def placed_agents(self) -> int:
        """Number of agents that fit on every map at a reset, for any random draw."""
        return min(for_each_map(self.network, self._placed_agents))

    def _placed_agents(self, number: int) -> int:
        length_m = float(self.blank["length"][0])
        if self.population.mode != "closed":  # further agents wait in the queue
            return int(self.trips_of(number).metres / (length_m + JAM_GAP_M))
        trips = self.demand.agent_trips
        origins = trips.pairs[trips.first[number] : trips.first[number + 1], 0]
        lanes_m = self.network.lanes["length_m"][np.unique(origins)]
        # A vehicle blocks the places up to its length and gap on both sides, or a short lane.
        places_m = lanes_m - length_m - END_ROOM_M
        blocked = np.maximum(places_m / (2.0 * (length_m + PLACE_GAP_M)), 1.0)
        return max(1, int(PLACED_SHARE * blocked.sum()))

    def _check_room(self) -> None:
        """Check that the population has room on each map, bumper to bumper.

        Raises CapacityError: there are more vehicles than fit.
        """
        for_each_map(self.network, self._check_room_of)

    def _check_room_of(self, number: int) -> None:
        metres = self.trips_of(number).metres
        room = int(metres / (float(self.blank["length"][0]) + JAM_GAP_M))
        agents, background = self.population.agents, self.population.background
        if agents + background > room:
            default = PopulationConfig.background
            stated = f"{background}, the default" if background == default else f"{background}"
            fewer = min(agents, self._placed_agents(number))
            cures = []
            if fewer < agents:
                cures.append(f"population.agents (agents=N, --agents N) to {fewer} or less")
            if fewer + background > room:
                most = max(room - fewer, 0)
                cures.append(
                    f"population.background (background=N, --background N) to {most} or less"
                )
            cure = "set " + " and ".join(cures)
            raise CapacityError(
                f"population.agents + population.background = {agents + background} (the "
                f"background is {stated}): the map '{self.network.name_of(number)}' has "
                f"{metres / 1000.0:.1f} km of lanes, room for {room} vehicles bumper to bumper; "
                f"{cure}"
            )


def capacity_of(
    network: RoadNetwork,
    population: PopulationConfig,
    file: DemandFile | SumoDemand | None,
    dt: float,
    horizon_s: float,
) -> int:
    """Return how many vehicles a world can hold; equals `NativeTraffic.capacity` of that world."""
    if isinstance(file, SumoDemand):
        return _capacity_of_sumo(population, file)
    schedule = None if file is None else Schedule(file, 0, 0)
    return _capacity(network, population, schedule, dt, horizon_s)


def _capacity_of_sumo(population: PopulationConfig, sumo: SumoDemand) -> int:
    return _own_vehicles(population) + sumo.max_vehicles + sumo.num_persons


def _own_vehicles(population: PopulationConfig) -> int:
    """Return the maximum number of vehicles of a population, without the demand's vehicles."""
    placed = population.agents + population.background
    return placed + population.insertions + population.external


def _capacity(
    network: RoadNetwork,
    population: PopulationConfig,
    schedule: Schedule | None,
    dt: float,
    horizon_s: float,
) -> int:
    """Return the number of rows: own vehicles, and as many ordered ones as fit on the map."""
    own = _own_vehicles(population)
    if schedule is None or not len(schedule.demand.types):
        return own
    shortest = float(schedule.demand.types["length"].min())
    metres = float(network.lanes["length_m"].sum())
    ordered = len(schedule.draw(0, horizon_s, dt))
    spread = 6 * math.isqrt(ordered) + 16
    return own + min(ordered + spread, int(metres / (shortest + JAM_GAP_M)) + 1)


def _centre_sees_line_m(kind: np.void, speed: float) -> float:
    """Return the distance in m from a vehicle's centre to a line at which it checks the line."""
    return float(see_line_m(kind, speed) + 0.5 * kind["length"])
