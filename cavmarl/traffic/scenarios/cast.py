"""`Cast`: the agents and actors of a scene as rows of a world.

The first agent starts in the conflict; the other agents start behind it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.core.errors import ConfigError
from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.core.math.geometry import lane_pose
from cavmarl.core.records.arrays import (
    DepartureQueue,
    LaneGrid,
    RoadArrays,
    Scripts,
    TripTables,
    Worlds,
)
from cavmarl.core.records.codes import COUNT_DEPARTED, DRIVER_SCRIPTED
from cavmarl.core.records.external_records import EXTERNAL_POSED, first_external_id
from cavmarl.driving.kernels.motion.scripted_rows import stand_at
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import lane_grid
from cavmarl.traffic.departure_queue import DEPARTURE
from cavmarl.traffic.kernels.demand_generator import enter
from cavmarl.traffic.kernels.external_rows import write_external
from cavmarl.traffic.scenarios.motions import Ride
from cavmarl.traffic.scenarios.movement_scripts import actor_types, bodies_of, compile_scripts
from cavmarl.traffic.scenarios.scene import Scene, Seat
from cavmarl.traffic.scenarios.streets import Streets

APART_M = 6.0  # m between the centres of consecutive agents, plus …
APART_S = 2.0  # … the distance driven in this time
START_M = 5.0  # m at the start of a lane where no vehicle is placed


def take_seats(streets: Streets, scene: Scene, num: int) -> list[Seat]:
    """Return the seats (starts) of `num` agents, beginning with the seat of the scene.

    The other agents follow on the approach of the first, with the same speed and goal. Their lanes
    are outside junctions, and no actor rides along them, because actors do not react to vehicles.

    Raises ConfigError: there is no room for this many agents behind the first.
    """
    rides = [act for actor in scene.actors for act in actor.acts if isinstance(act, Ride)]
    closed = {lane for ride in rides for lane in ride.lanes}
    seats = [scene.seat]
    lane, s = scene.seat.lane, scene.seat.s
    while len(seats) < num:
        s -= APART_M + APART_S * scene.seat.speed_mps
        while s < START_M:
            closed.add(lane)
            before = streets.before(lane)
            if before is None or before in closed:
                raise ConfigError(
                    f"population.agents = {num}: behind the agent of the scene at '{scene.place}' "
                    f"on the map '{streets.network.name}' there is room for only {len(seats) - 1} "
                    f"more; set at most {len(seats)}, or choose another scenario.place"
                )
            lane = before
            s += streets.length_m(lane)
        row = streets.network.lanes[lane]
        if not row["internal"]:
            speed_mps = min(scene.seat.speed_mps, float(row["speed_mps"]))
            seats.append(replace(scene.seat, lane=lane, s=s, speed_mps=speed_mps))
    return seats


SEAT_CLEAR_M = 30.0  # m that are kept clear around every seat except the first


@dataclass(frozen=True)
class Cast:
    """The actors of a scene, ready to enter worlds."""

    scene: Scene
    scripts: Scripts  # tables of the scripts
    firsts: list[int]  # first FRAME of each actor
    types: NDArray[np.void]  # VTYPE rows of all bodies
    vtypes: list[int]  # (n,) VTYPE row of each actor, among all types of a world
    seats: list[Seat]  # seats of the agents
    goals: list[int]  # row of the table of plans of each agent
    grid: LaneGrid  # grid of the map

    @staticmethod
    def of(
        scene: Scene,
        network: RoadNetwork,
        goals: Mapping[int, int],
        first_type: int,
        dt: float,
        num_agents: int = 1,
    ) -> Cast:
        """Return the cast of a scene.

        `goals`: row of the table of plans by EDGE. `first_type`: number of vehicle types before the
        actors' types. `num_agents`: agents per world.

        Raises ConfigError: the scene has no room for this many agents.
        """
        seats = list(scene.seats) or take_seats(Streets(network), scene, num_agents)
        scripts, firsts = compile_scripts(network, scene.actors, scene.cues, goals, dt)
        vtypes = [first_type + number for number in bodies_of(scene.actors)]
        own = [goals[seat.goal_edge] for seat in seats]
        grid = lane_grid(network)
        return Cast(scene, scripts, firsts, actor_types(), vtypes, seats, own, grid)

    def enter(
        self,
        roads: RoadArrays,
        travel: TripTables,
        departures: DepartureQueue,
        worlds: Worlds,
        w: int,
        blank: NDArray[np.void],
    ) -> None:
        """Place the agents and the actors in a world that has just been populated.

        Other vehicles in the scene are removed. Agents keep their ids, and actors get the next ids.

        `worlds`: the rows of world w are written; the world is not yet divided. `blank`: VEHICLE
        (1,), template of every vehicle's record.
        """
        rows = worlds.rows[w]
        others = rows[: worlds.num_owned[w]]
        others = others[(others["agent"] < 0) & self._is_clear(roads, others)].copy()
        queue = departures.queue[w, : departures.num_queue[w]]
        queue = queue[queue["agent"] < 0].copy()
        departures.queue[w, : len(queue)] = queue
        departures.num_queue[w] = len(queue)
        for agent, seat in enumerate(self.seats):
            row = rows[agent]
            rows[agent] = blank[0]
            departure = self._departure(roads, agent, seat)
            _enter_seat(roads, travel, worlds, w, departure, seat, row)
        num = len(self.seats)
        rows[num : num + len(others)] = others
        num += len(others)
        for first, vtype in zip(self.firsts, self.vtypes, strict=True):
            row = rows[num]
            rows[num] = blank[0]
            row["id"] = departures.next_id[w]
            row["driver"] = DRIVER_SCRIPTED
            row["vtype"], row["goal"] = vtype, first
            for name in ("length", "width", "height"):
                row[name] = travel.types[name][vtype]
            row["rng_key"], row["departed"], row["tick"] = (
                worlds.keys[w], worlds.ticks[w], worlds.ticks[w],
            )  # fmt: skip
            stand_at(self.scripts.frames[first], row)
            departures.next_id[w] += 1
            num += 1
        departures.counts[w, COUNT_DEPARTED] = num
        worlds.num_owned[w] = worlds.num_rows[w] = num

    def enter_logged(
        self,
        roads: RoadArrays,
        travel: TripTables,
        departures: DepartureQueue,
        worlds: Worlds,
        w: int,
        blank: NDArray[np.void],
        first_slot: int,  # slot of the first replayed road user
        first_commands: NDArray[np.void],  # EXTERNAL (L,), state of the replayed users at the reset
        nowhere: int,  # VEHICLE["way"] of a vehicle without a route
    ) -> None:
        """Place the logged vehicles that are present at the reset, except agents' vehicles.

        Vehicles with an order get the next ids; replayed vehicles get the ids of their slots.
        """
        log = self.scene.log
        assert log is not None, "the scene of a file has a log"
        rows, num = worlds.rows[w], int(worlds.num_owned[w])
        orders = departures.orders[w, : departures.num_orders[w]]
        for order, one in zip(orders[orders["due"] <= 0], log.reacting, strict=False):
            row = rows[num]
            rows[num] = blank[0]
            order["id"] = departures.next_id[w]
            _enter_seat(roads, travel, worlds, w, order, one.seat, row)
            departures.next_id[w] += 1
            departures.next_order[w] += 1
            num += 1
        departures.counts[w, COUNT_DEPARTED] = num
        slots = first_slot + len(first_commands)
        for k, told in enumerate(first_commands):
            if told["kind"] != EXTERNAL_POSED:
                continue
            rows[num] = blank[0]
            slot = first_slot + k
            vehicle = first_external_id(worlds.ticks[w], slots) + slot
            write = specialized(write_external)
            write(roads, self.grid, told, vehicle, slot, nowhere, worlds.keys[w],
                  worlds.ticks[w], rows[num])  # fmt: skip
            num += 1
        worlds.num_owned[w] = worlds.num_rows[w] = num

    def _is_clear(self, roads: RoadArrays, rows: NDArray[np.void]) -> NDArray[np.bool_]:
        """Return which vehicles (n,) are neither in the scene nor near the seat of an agent."""
        clear: NDArray[np.bool_] = (
            hypot_all(rows["x"] - self.scene.x, rows["y"] - self.scene.y) > self.scene.clear_m
        )
        for seat in self.seats[1:]:
            lane = roads.lanes[seat.lane]
            x, y, *_ = lane_pose(roads.points, lane["first_point"], lane["num_points"], seat.s)
            clear &= hypot_all(rows["x"] - x, rows["y"] - y) > SEAT_CLEAR_M
        return clear

    def _departure(self, roads: RoadArrays, agent: int, seat: Seat) -> np.void:
        """Return a DEPARTURE with the fields that the entry of an agent uses."""
        departure: np.void = np.zeros(1, DEPARTURE)[0]
        for name in ("order", "stop", "stops_end"):
            departure[name] = -1
        departure["id"] = departure["agent"] = agent
        departure["goal"] = self.goals[agent]
        departure["way"] = self.goals[agent] * len(roads.lanes)
        departure["speed_factor"] = seat.speed_mps / roads.lanes["speed_mps"][seat.lane]
        return departure


def _enter_seat(
    roads: RoadArrays,
    travel: TripTables,
    worlds: Worlds,
    w: int,
    departure: np.void,
    seat: Seat,
    row: np.void,  # VEHICLE, blank; written
) -> None:
    """Write the record of a vehicle that starts in a seat."""
    if roads.lanes["internal"][seat.lane]:
        row["link"] = roads.lanes["link"][seat.lane]
    enter(roads, travel, worlds, w, departure, seat.lane, seat.s, seat.speed_mps, row)
    if seat.body is not None:
        for name in ("x", "y", "heading", "d", "length", "width", "height"):
            row[name] = getattr(seat.body, name)
