"""`Shard`: the vehicles of one zone in W worlds.

A shard has the arrays of its vehicles, its part of the map, its sensors and its terms. It has no
access to the coordinator or to other shards. A `ShardGroup` runs the ticks of one or more shards.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.huge_pages import huge_zeros
from cavmarl.core.math.buckets import make_lists
from cavmarl.core.math.neighbors import make_grid
from cavmarl.core.memory import Zeros
from cavmarl.core.records.arrays import (
    LaneGrid,
    Outputs,
    RoadArrays,
    Scratch,
    SharedState,
    TripTables,
    Worlds,
    ZoneState,
)
from cavmarl.core.records.external_records import EXTERNAL_FIELDS
from cavmarl.driving.kernels.junctions.approach import APPROACH
from cavmarl.driving.kernels.lanes.lane_index import ENTRY
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import PLAN, lane_grid
from cavmarl.sensors.observed import layout, optional_arrays, sensor_arrays
from cavmarl.shards.kernels.learned_driving import LearnedDriver
from cavmarl.shards.kernels.world_phases import suggest
from cavmarl.shards.learned_drivers import learned_drivers
from cavmarl.shards.registered_outputs import RegisteredOutputs
from cavmarl.v2x.kernels.v2x_records import REPORT, Mail
from cavmarl.zones.kernels.zone_lookup import OUTER, Halo, ZoneArrays

CELL_M = 25.0  # side of a cell of the spatial index over vehicles
COMMON = SharedState._fields
TICKS_IN_ORDER = 32  # ticks between two sorts of the rows by lane
SUGGESTED_HORIZON_S = 1.0  # time in which a suggested target speed should be reached

# The state of one actuated signal program in a world.
CONTROLLER = np.dtype(
    [
        ("phase", np.int64),  # index of the current PHASE row
        ("since_ms", np.int64),  # time since the reset at which the phase began
        ("next_ms", np.int64),  # time of the next decision whether the phase continues
    ],
    align=True,
)


@dataclass(frozen=True)
class Commands:
    """Decoded actions of one step.

    The default of an array has a shape with zeros. The comments explain what this shape means.
    """

    # (W, A, 2) throttle in m/s² and steering in rad; continuous actions
    controls: NDArray[np.float64]
    meta_actions: NDArray[np.int64]  # (W, A) ACTION_* codes; discrete actions
    # (W, A) CAUSE_* of the events that agents send in messages, 0: none; (0, 0): no messages
    declared: NDArray[np.int32] = field(default_factory=lambda: np.zeros((0, 0), np.int32))
    # (W, I, 3) INSERT_* code, LANE and position in m of inserted vehicles; (0, 0, 3): insertions
    # are not configured
    inserted: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0, 3)))
    # (W, E, K) new commands, the K fields of EXTERNAL, to vehicles that the caller places or
    # drives; (0, 0, K): such vehicles are not configured
    external: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0, EXTERNAL_FIELDS)))
    # (W, N, 2) LINK row and 1 + SIGNAL_* code of each link whose signal the caller overrides, 0: an
    # unused place; (0, 0, 2): overrides are not configured
    overridden: NDArray[np.int32] = field(default_factory=lambda: np.zeros((0, 0, 2), np.int32))
    # (W, N, 3) LANE_CHANGE of each lane that differs from the map; (0, 0, 3): lanes never change
    lane_changes: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0, 3)))
    # (W, S) choices of the agents of signals, -1: none; (0, 0): signals have no agents
    signal_choices: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 0), np.int64))


COMMANDS = tuple(entry.name for entry in fields(Commands))


class Shard:
    """The vehicles of one zone in W worlds.

    Attributes:
        sides: VEHICLE (W, C), the two buffers for rows.
        side: index of the buffer with the committed rows.
        next_side: index of the buffer for the next rows; it differs in ticks that sort rows.
    """

    def __init__(
        self,
        config: EnvConfig,
        network: RoadNetwork,
        *,
        plans: NDArray[np.void],  # PLAN (V, goals, lanes), routes of agents; V as in `Worlds.lanes`
        travel: TripTables,
        zoned: ZoneState,  # the rows of all zones
        outputs: Outputs,  # outputs of the agents of all shards, by agent index
        zone: int,
        zones: ZoneArrays,
        halo: Halo,  # how far zones see beyond their borders
        # the first shard of this process, whose clock, keys, signals and scratch memory this shard
        # shares; None: this is the first shard
        first: Shard | None = None,
        zeros: Zeros = np.zeros,  # allocates the state that all zones share
    ) -> None:
        self.zone = zone
        self.zoned = zoned
        self.config = config
        self.roads: RoadArrays = network.arrays
        self.plans = plans
        self.travel = travel
        self.lane_grid: LaneGrid = lane_grid(network)
        self.sensors = sensor_arrays(config.sensors, network)
        most_told = config.v2x.inbox.objects
        num_worlds, capacity = zoned.rows.shape[2:]
        self.optional = optional_arrays(config.sensors, network, plans[0], most_told, capacity)
        self.registered = RegisteredOutputs(config, network)
        # Neural networks that drive background vehicles; shards also share their scratch memory.
        self.learned: tuple[LearnedDriver, ...] = (
            learned_drivers(config, network, plans[0], capacity) if first is None else first.learned
        )
        self._floating = len(network.maps) > 1
        self._extent_m = network.room_m
        self.cut(zones, halo)
        # Shards run one after the other and share this memory, so that it stays in the cache.
        self.scratch: Scratch = (
            make_shard_scratch(network, capacity, travel.scripts.room)
            if first is None
            else first.scratch
        )
        self.worlds: Worlds = make_worlds(
            num_worlds,
            capacity,
            network,
            num_agents=config.population.num_ids,
            latency_ticks=config.clock.control_latency_ticks,
            zoned=zoned,
            zone=zone,
            common=None if first is None else first.worlds,
            zeros=zeros,
            num_cues=len(travel.scripts.cues),
        )
        if first is None and (more := override_columns(config, network)):
            columns = zeros((num_worlds, len(network.signals) + more), dtype=np.int32)
            self.worlds = self.worlds._replace(signal_phase=columns)
        # LANE (W, L), for writing: the tables in `Worlds.lanes` of worlds that may change lanes
        self.own_lanes: NDArray[np.void] = (
            network.arrays.lanes[np.newaxis][:0] if first is None else first.own_lanes
        )
        if first is None and config.may_change_lanes:
            tables = make_lane_tables(network, num_worlds, zeros)
            self.worlds = self.worlds._replace(lanes=_read_only(tables))
            self.own_lanes = tables[1:]
        self.sides = (self.worlds.rows, zoned.rows[1, zone])
        self.side = self.next_side = 0
        # `side` and `next_side` for kernels: (2,), one array for all shards of this process.
        self.row_sides: NDArray[np.int64] = (
            np.zeros(2, dtype=np.int64) if first is None else first.row_sides
        )
        self.outputs = outputs
        self.mail: Mail | None = None  # messages that agents have received; None: no messages
        self.no_reports = np.zeros((num_worlds, config.population.num_ids, 0), REPORT)
        self.messages_at = layout(config.sensors).get("messages")
        self.target_speeds = np.array(config.action.target_speeds_mps)
        self.discrete = config.action.kind == "discrete"

    def cut(self, zones: ZoneArrays, halo: Halo) -> None:
        """Set the zones. The caller must then make new `ShardGroup`s with this shard."""
        self.zones = zones
        self.halo = halo
        seen = self._extent_m
        if not self._floating:
            seen = _seen(seen, zones, self.zone, halo.halo_m)
        self.grid = make_grid(seen, CELL_M, self.zoned.rows.shape[3], self._floating)

    def align(self) -> None:
        """Use the first buffer for all rows after an abandoned tick."""
        self.set_sides(0, 0)

    def set_sides(self, side: int, next_side: int) -> None:
        self.side, self.next_side = side, next_side
        self.row_sides[:] = side, next_side
        self.worlds = self.worlds._replace(rows=self.sides[side], next_rows=self.sides[next_side])

    def suggest(self, out: NDArray[np.float64]) -> None:
        """Write the actions that the built-in driver would take for agents to `out` (W, A, 2)."""
        suggest(
            self.roads,
            self.plans,
            self.travel,
            self.worlds,
            self.scratch,
            self.discrete,
            self.target_speeds,
            SUGGESTED_HORIZON_S,
            self.config.clock.ctrl_dt_s,
            out,
        )


def make_worlds(
    num_worlds: int,
    capacity: int,
    network: RoadNetwork,
    num_agents: int = 0,
    latency_ticks: int = 0,
    zoned: ZoneState | None = None,
    zone: int = 0,
    common: Worlds | None = None,
    zeros: Zeros = np.zeros,
    num_cues: int = 0,
) -> Worlds:
    """Return the arrays of W empty worlds with room for `capacity` vehicles each.

    Agents' commands take effect `latency_ticks` later; scripts wait for `num_cues` cues. If
    `zoned` is given, the rows are views of its zone `zone`. The state that all zones share (ticks,
    keys, signals, detections, cues) comes from `common`, if given; else `zeros` allocates it.
    """
    if zoned is None:
        zoned = make_zone_state(1, num_worlds, capacity)
    rows = zoned.rows[0, zone]
    worlds = Worlds(
        rows=rows,
        next_rows=rows,
        num_owned=zoned.num_owned[zone],
        num_rows=zoned.num_rows[zone],
        ticks=zeros(num_worlds, dtype=np.int64),
        keys=zeros(num_worlds, dtype=np.uint64),
        signal_phase=zeros((num_worlds, len(network.signals)), dtype=np.int32),
        controllers=zeros((num_worlds, network.num_controllers), dtype=CONTROLLER),
        detected_s=zeros((num_worlds, len(network.detectors)), dtype=np.float64),
        num_through=zoned.num_through[zone],
        pending=zeros((num_worlds, num_agents, latency_ticks + 1, 2)),
        num_near=zoned.num_near[zone],
        num_touching=zoned.num_touching[zone],
        num_contacts=zoned.num_contacts[zone],
        step=zoned.step[zone],
        step_at=zoned.step_at[zone],
        outer=zoned.outer[zone],
        num_outer=zoned.num_outer[zone],
        cues=zeros((num_worlds, num_cues), dtype=np.int64),
        lanes=network.arrays.lanes[np.newaxis],
    )
    if common is None:
        return worlds
    return worlds._replace(**{name: getattr(common, name) for name in COMMON})


def make_lane_tables(network: RoadNetwork, num_worlds: int, zeros: Zeros) -> NDArray[np.void]:
    """Return LANE (1 + W, L): the lanes of the map, and a copy for each world."""
    lanes = network.arrays.lanes
    tables = zeros((1 + num_worlds, len(lanes)), dtype=lanes.dtype)
    tables[:] = lanes
    return tables


def _read_only(array: NDArray[np.void]) -> NDArray[np.void]:
    """Return a view that cannot be written; kernels are compiled for immutable lanes."""
    view = array[:]
    view.setflags(write=False)
    return view


def override_columns(config: EnvConfig, network: RoadNetwork) -> int:
    """Return how many columns `Worlds.signal_phase` has for overrides, after those of signals."""
    return len(network.links) if config.signals.overrides else 0


def common_of(worlds: Worlds) -> SharedState:
    """Return the state that all shards share, from the worlds of any of them."""
    return SharedState(**{name: getattr(worlds, name) for name in COMMON})


def make_zone_state(
    num_zones: int, num_worlds: int, capacity: int, zeros: Zeros = np.zeros
) -> ZoneState:
    """Return empty rows of all zones in W worlds, with room for `capacity` vehicles each."""
    # Memory that is never written takes no physical pages.
    numbers = zeros((8, num_zones, num_worlds), dtype=np.int64)
    numbers[7] = -1
    shape = (num_zones, num_worlds, capacity)
    return ZoneState(
        rows=zeros((2, *shape), dtype=VEHICLE),
        num_owned=numbers[0],
        num_rows=numbers[1],
        num_near=numbers[2],
        num_through=numbers[3],
        num_touching=numbers[4],
        num_contacts=numbers[5],
        step=zeros(shape, dtype=PLAN),
        step_at=zeros(shape, dtype=np.int64),
        outer=zeros(shape, dtype=OUTER),
        num_outer=numbers[7],
        border=zeros(shape, dtype=np.int32),
        num_border=numbers[6],
        spare=np.zeros(1, dtype=VEHICLE),
    )


def _seen(
    extent_m: tuple[float, float, float, float], zones: ZoneArrays, zone: int, halo_m: float
) -> tuple[float, float, float, float]:
    """Return the part of the map in which a zone has vehicles or ghosts."""
    min_x, min_y, max_x, max_y = extent_m
    left, low, right, high = zones.rects[zone].tolist()
    return (
        max(min_x, left - halo_m),
        max(min_y, low - halo_m),
        min(max_x, right + halo_m),
        min(max_y, high + halo_m),
    )


def make_shard_scratch(network: RoadNetwork, capacity: int, covers: int = 0) -> Scratch:
    def integers(size: int) -> NDArray[np.int32]:
        return huge_zeros(size, dtype=np.int32)

    def floats(size: int) -> NDArray[np.float64]:
        return huge_zeros(size, dtype=np.float64)

    lanes = make_lists(len(network.lanes) + 1, huge_zeros)
    links = make_lists(len(network.links), huge_zeros)
    return Scratch(
        lanes=lanes,
        lane_start=lanes.bounds[:, 0],
        lane_end=lanes.bounds[:, 1],
        entries=huge_zeros(2 * capacity + covers, dtype=ENTRY),
        links=links,
        link_start=links.bounds[:, 0],
        link_end=links.bounds[:, 1],
        approach=huge_zeros(4 * capacity, dtype=APPROACH),
        largest=np.zeros(len(network.junctions), dtype=np.int8),
        pairs=huge_zeros(4 * capacity, dtype=APPROACH),
        order=integers(capacity),
        accel=floats(capacity),
        link_ahead=integers(capacity),
        lane_change=integers(capacity),
        blinker=integers(capacity),
        hold=integers(capacity),
        hit=huge_zeros(capacity, dtype=np.int64),
    )
