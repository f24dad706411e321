"""`Shard`: the running sub-worlds of one zone, W of them side by side.

It owns the arrays of its vehicles and runs the phases of a tick on them. It knows its part of the
map, its sensors and its terms, and neither the coordinator nor another shard.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.config import EnvConfig
from cavmarl.kernels.admission import admit, propose, rank_lanes
from cavmarl.kernels.approach import APPROACH
from cavmarl.kernels.arrays import (
    Demand,
    Gate,
    LaneGrid,
    Outputs,
    RoadArrays,
    Scratch,
    Travel,
    Worlds,
)
from cavmarl.kernels.codes import DRIVER_AGENT, DRIVER_BACKGROUND
from cavmarl.kernels.departures import choose_goals
from cavmarl.kernels.lanes import ENTRY
from cavmarl.kernels.leaving import drop_ghosts, leave
from cavmarl.kernels.neighbors import make_grid
from cavmarl.kernels.observe_further import observe_further
from cavmarl.kernels.outputs import credit
from cavmarl.kernels.sense import sense
from cavmarl.kernels.signals import detect
from cavmarl.kernels.stacking import fill_stacks
from cavmarl.kernels.tick import advance, begin_step, resolve, suggest
from cavmarl.kernels.zones import Halo, ZoneArrays
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import PLAN, lane_grid
from cavmarl.shard.controllers import CONTROLLER
from cavmarl.shard.sensors import further_arrays, sensor_arrays
from cavmarl.shard.vehicles import VEHICLE

__all__ = ["Commands", "Shard", "make_worlds"]

CELL_M = 25.0  # of the spatial index over vehicles
# Fields of `Worlds` that the shards of one world have in common.
COMMON = ("ticks", "keys", "signal_phase", "controllers", "detected_s", "pending")
TICKS_IN_ORDER = 32  # for so long rows that have been put in the order of the lanes nearly stay so
SUGGESTED_HORIZON_S = 1.0  # in which a suggested target speed is to be reached


@dataclass(frozen=True)
class Commands:
    """Decoded actions of one step.

    Attributes:
        controls: (W, A, 2) throttle in m/s² and steering in rad; continuous actions.
        meta_actions: (W, A) ACTION_* codes; discrete actions.
    """

    controls: NDArray[np.float64]
    meta_actions: NDArray[np.int64]


class Shard:
    """The sub-worlds of one zone.

    Args:
        config: the environment.
        network: the roads.
        plans: PLAN (G, L), the ways of agents.
        travel: types and ways.
        num_worlds: W.
        capacity: rows a world can hold.
        outputs: where the agents of all shards get what they sense, each at its own index.
        zone: which one.
        zones: of the partition.
        halo: how far it sees over its borders.
        touching_m: no ghost further outside of the zone can touch one of its vehicles.
        common: whose clock, keys and signals these worlds share, those of the first shard; None:
            this is the first one.
    """

    def __init__(
        self,
        config: EnvConfig,
        network: RoadNetwork,
        plans: NDArray[np.void],
        travel: Travel,
        num_worlds: int,
        capacity: int,
        outputs: Outputs,
        zone: int,
        zones: ZoneArrays,
        halo: Halo,
        touching_m: float,
        common: Worlds | None = None,
    ) -> None:
        self.zone = zone
        self._zones = zones
        self._halo = halo
        self._touching_m = touching_m
        self._config = config
        self._roads: RoadArrays = network.arrays
        self._plans = plans
        self._travel = travel
        self._lane_grid: LaneGrid = lane_grid(network)
        self._sensors = sensor_arrays(config.sensors)
        self._further = further_arrays(config.sensors, network, plans)
        self._grid = make_grid(network.extent_m, CELL_M, capacity)
        self.scratch = _make_scratch(len(network.lanes), len(network.links), capacity)
        self.worlds: Worlds = make_worlds(
            num_worlds,
            capacity,
            network,
            config.population.num_ids,
            config.clock.control_latency_ticks,
            common,
        )
        self._spare_rows = np.zeros_like(self.worlds.rows)
        self.outputs = outputs
        self._target_speeds = np.array(config.action.target_speeds_mps)
        self._discrete = config.action.kind == "discrete"

    def detect(self) -> None:
        """Note when owned bodies were over the detectors of actuated signals."""
        worlds = self.worlds
        if worlds.controllers.shape[1] == 0:
            return
        detect(
            self._roads.lane_place,
            self._roads.places,
            worlds.rows,
            worlds.num_owned,
            worlds.ticks,
            self._config.clock.sim_dt_s,
            worlds.detected_s,
        )

    def begin_step(self, commands: Commands) -> None:
        """Open the accounts of a step and take its meta-actions."""
        if self._config.population.agents == 0:
            return
        begin_step(
            self._roads, self.worlds, self._discrete, commands.meta_actions, self._target_speeds
        )

    def advance(self, commands: Commands) -> None:
        """Decide every control from the committed rows and move the owned ones into `next_rows`."""
        action = self._config.action
        # Of a divided world tick t stays whole until t + 1 is committed (docs/ownership.md).
        undivided = len(self._zones.rects) == 1
        in_place = undivided and self.worlds.ticks[0] % TICKS_IN_ORDER != 0
        if not in_place:
            self.worlds = self.worlds._replace(next_rows=self._spare_rows)
        advance(
            self._roads,
            self._plans,
            self._travel,
            self._lane_grid,
            self.worlds,
            self.scratch,
            commands.controls,
            self._discrete,
            action.acceleration_mps2,
            action.steering_rad,
            self._config.clock.sim_dt_s,
            bool(in_place),
        )

    def resolve(self) -> None:
        """Find who touches whom in `next_rows`."""
        rect = self._zones.rects[self.zone]
        resolve(self.worlds, self.scratch, self._grid, rect, self._touching_m)

    def choose_goals(self, demand: Demand, num_goals: int, gate: Gate) -> None:
        """Give the vehicles of `next_rows` that need it another goal."""
        dt = self._config.clock.sim_dt_s
        choose_goals(demand, self._roads, self._travel, num_goals, gate, self.worlds, dt)

    def leave(self, gate: Gate) -> None:
        """Hand the background vehicles of `next_rows` that have arrived to the gate."""
        leave(gate, self.worlds, self.worlds.next_rows, DRIVER_BACKGROUND, 1)

    def retire(self, gate: Gate) -> None:
        """Hand the agents' vehicles of the committed rows whose trip has ended to the gate."""
        ticks = self._config.clock.ticks_per_step
        leave(gate, self.worlds, self.worlds.rows, DRIVER_AGENT, ticks)

    def forget(self, gate: Gate) -> None:
        """Drop the ghosts of those who have been retired."""
        drop_ghosts(gate, self.worlds, self.worlds.rows)

    def rank_lanes(self, gate: Gate) -> None:
        """Count who is around the places of this zone where departures may enter."""
        rank_lanes(
            self._roads, self._travel, self._zones, self.zone, gate, self.worlds, self.scratch
        )

    def propose(self, demand: Demand, gate: Gate) -> None:
        """Tell the gate which departures find a safe gap in this zone."""
        propose(
            demand,
            self._roads,
            self._travel,
            self._zones,
            self.zone,
            gate,
            self.worlds,
            self.scratch,
        )

    def admit(self, gate: Gate) -> None:
        """Take in those whom the gate has accepted, as owned or as ghosts."""
        admit(self._zones, self._halo, self.zone, gate, self.worlds)

    def commit(self) -> None:
        """Make `next_rows` the committed state."""
        worlds = self.worlds
        if worlds.next_rows is not worlds.rows:
            self._spare_rows = worlds.rows
            self.worlds = worlds._replace(rows=worlds.next_rows)

    def sense(self, chosen: NDArray[np.bool_]) -> None:
        """Write observations and terms of the chosen worlds' owned agents into `outputs`."""
        sense(
            self._roads,
            self._plans,
            self._travel,
            self.worlds,
            self._grid,
            self._sensors,
            self._config.clock.sim_dt_s,
            self._config.clock.ticks_per_step,
            chosen,
            self.outputs,
        )
        observations, stack = self.outputs.observations, self._config.sensors.stack
        if self._further is not None:
            observe_further(
                self._roads,
                self._lane_grid,
                self.worlds,
                self._grid,
                self._further,
                stack,
                chosen,
                observations,
            )
        if stack > 1:
            ticks_per_step = self._config.clock.ticks_per_step
            fill_stacks(self.worlds, ticks_per_step, stack, chosen, observations)

    def credit(self, chosen: NDArray[np.bool_]) -> None:
        """Add the step's rewards to the episode's of the chosen worlds' owned agents."""
        credit(self.worlds.rows, self.worlds.num_owned, self.outputs.rewards, chosen)

    def suggest(self, out: NDArray[np.float64]) -> None:
        """Write what the built-in driver would do in the agents' place into `out` (W, A, 2)."""
        suggest(
            self._roads,
            self._plans,
            self._travel,
            self.worlds,
            self.scratch,
            self._discrete,
            self._target_speeds,
            SUGGESTED_HORIZON_S,
            self._config.clock.sim_dt_s,
            out,
        )


def make_worlds(
    num_worlds: int,
    capacity: int,
    network: RoadNetwork,
    num_agents: int = 0,
    latency_ticks: int = 0,
    common: Worlds | None = None,
) -> Worlds:
    """Arrays of W worlds that hold `capacity` vehicles each, all of them empty.

    Agents' commands take effect `latency_ticks` later. What all zones of a world have in
    common (ticks, keys, signals and what detectors saw) are the arrays of `common`, if it is given.
    """
    shape = (num_worlds, capacity)
    rows = np.zeros(shape, dtype=VEHICLE)
    worlds = Worlds(
        rows=rows,
        next_rows=rows,
        num_owned=np.zeros(num_worlds, dtype=np.int64),
        num_rows=np.zeros(num_worlds, dtype=np.int64),
        ticks=np.zeros(num_worlds, dtype=np.int64),
        keys=np.zeros(num_worlds, dtype=np.uint64),
        signal_phase=np.zeros((num_worlds, len(network.signals)), dtype=np.int32),
        controllers=np.zeros((num_worlds, network.num_controllers), dtype=CONTROLLER),
        detected_s=np.zeros((num_worlds, len(network.detectors)), dtype=np.float64),
        num_through=np.zeros(num_worlds, dtype=np.int64),
        pending=np.zeros((num_worlds, num_agents, latency_ticks + 1, 2)),
        num_touching=np.zeros(num_worlds, dtype=np.int64),
        num_contacts=np.zeros(num_worlds, dtype=np.int64),
    )
    if common is None:
        return worlds
    return worlds._replace(**{name: getattr(common, name) for name in COMMON})


def _make_scratch(num_lanes: int, num_links: int, capacity: int) -> Scratch:
    def integers(size: int) -> NDArray[np.int32]:
        return np.zeros(size, dtype=np.int32)

    def floats(size: int) -> NDArray[np.float64]:
        return np.zeros(size, dtype=np.float64)

    return Scratch(
        lane_start=integers(num_lanes + 1),
        lane_end=integers(num_lanes),
        entries=np.zeros(2 * capacity, dtype=ENTRY),
        step=np.zeros(capacity, dtype=PLAN),
        step_at=np.full(capacity, -1, dtype=np.int64),
        link_start=integers(num_links + 2),
        approach=np.zeros(3 * capacity, dtype=APPROACH),
        pairs=np.zeros(3 * capacity, dtype=APPROACH),
        order=integers(capacity),
        accel=floats(capacity),
        link_ahead=integers(capacity),
        lane_change=integers(capacity),
        blinker=integers(capacity),
        hold=integers(capacity),
        hit=np.zeros(capacity, dtype=np.int64),
        spare=np.zeros(1, dtype=VEHICLE),
    )
