"""Phases of a tick in several zones of one process, each in one call.

A call takes some sixty arrays from Python, which in a small zone takes longer than what is done
with them. So the kernels of one zone are called from here, one zone after the other, with views of
`Zoned`. What a zone does depends on its own rows alone, whichever zones are called with it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.neighbors import Grid
from cavmarl.core.records.arrays import (
    Common,
    Demand,
    Gate,
    LaneGrid,
    Outputs,
    RoadArrays,
    Scratch,
    Sensors,
    Travel,
    Worlds,
    Zoned,
)
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.rewards.kernels.reward import credit
from cavmarl.roads.kernels.signal_phases import detect
from cavmarl.sensors.kernels.sense import sense
from cavmarl.shards.kernels.world_phases import advance, begin_step, resolve
from cavmarl.traffic.kernels.admission import admit, propose, rank_lanes
from cavmarl.traffic.kernels.barriers import drive_on
from cavmarl.traffic.kernels.demand_generator import choose_goals
from cavmarl.traffic.kernels.leaving import drop_ghosts, leave
from cavmarl.zones.kernels.ghost_exchange import gather
from cavmarl.zones.kernels.zone_lookup import Halo, ZoneArrays

FRAME = np.dtype(
    [
        ("corner_x", np.float64),  # see `neighbors.Grid`
        ("corner_y", np.float64),
        ("cells_per_m", np.float64),
        ("num_x", np.int64),
        ("num_y", np.int64),
    ],
    align=True,
)


class Members(NamedTuple):
    """The zones that are called together."""

    numbers: NDArray[np.int64]  # (n,) which ones, rising
    frames: NDArray[np.void]  # FRAME (n,) of the spatial index of each
    zones: ZoneArrays  # of the partition
    halo: Halo
    zoned: Zoned
    common: Common


@inlined_kernel
def _worlds(members: Members, zone: int, side: int, next_side: int) -> Worlds:
    """A zone's part of all worlds, its rows on one side and its next ones on another."""
    zoned = members.zoned
    common = members.common
    return Worlds(
        rows=zoned.rows[side, zone],
        next_rows=zoned.rows[next_side, zone],
        num_owned=zoned.num_owned[zone],
        num_rows=zoned.num_rows[zone],
        ticks=common.ticks,
        keys=common.keys,
        signal_phase=common.signal_phase,
        controllers=common.controllers,
        detected_s=common.detected_s,
        num_through=zoned.num_through[zone],
        pending=common.pending,
        num_near=zoned.num_near[zone],
        num_touching=zoned.num_touching[zone],
        num_contacts=zoned.num_contacts[zone],
        step=zoned.step[zone],
        step_at=zoned.step_at[zone],
        outer=zoned.outer[zone],
        num_outer=zoned.num_outer[zone],
        cues=common.cues,
    )


@inlined_kernel
def _grid(frame: np.void, scratch_grid: Grid) -> Grid:
    """A zone's spatial index, in the scratch of the largest one."""
    cells = frame["num_x"] * frame["num_y"]
    scratch_grid.corner[0] = frame["corner_x"]
    scratch_grid.corner[1] = frame["corner_y"]
    return Grid(
        corner=scratch_grid.corner,
        floating=scratch_grid.floating,
        cells_per_m=frame["cells_per_m"],
        num_x=frame["num_x"],
        num_y=frame["num_y"],
        start=scratch_grid.start[: cells + 1],
        bodies=scratch_grid.bodies,
        cell=scratch_grid.cell,
        largest=scratch_grid.largest,
        newest=scratch_grid.newest[:cells],
        spots=scratch_grid.spots,
    )


@kernel
def advance_each(
    members: Members,
    side: int,
    next_side: int,
    roads: RoadArrays,
    plans: NDArray[np.void],
    travel: Travel,
    lane_grid: LaneGrid,
    scratch: Scratch,
    commands: NDArray[np.float64],
    discrete: bool,
    accel_limit: float,
    steering_limit: float,
    dt: float,
) -> int:
    """`advance` in each zone, in place if the sides are the same; how many have arrived in all."""
    arrived = 0
    for zone in members.numbers:
        arrived += advance(
            roads,
            plans,
            travel,
            lane_grid,
            _worlds(members, zone, side, next_side),
            members.halo.inner[zone],
            scratch,
            commands,
            discrete,
            accel_limit,
            steering_limit,
            dt,
            side == next_side,
        )
    return arrived


@kernel
def gather_each(members: Members, side: int, touching_m: float, border_m: float) -> None:
    """`gather` in each zone; zones of other calls may run beside it."""
    for w in range(members.common.ticks.size):
        for zone in members.numbers:
            gather(members.zones, members.halo, touching_m, border_m, members.zoned, side, zone, w)


@kernel
def resolve_each(
    members: Members, side: int, next_side: int, scratch: Scratch, scratch_grid: Grid
) -> None:
    for n in range(members.numbers.size):
        worlds = _worlds(members, members.numbers[n], side, next_side)
        resolve(worlds, scratch, _grid(members.frames[n], scratch_grid))


@kernel
def begin_step_each(
    members: Members,
    side: int,
    roads: RoadArrays,
    discrete: bool,
    meta_actions: NDArray[np.int64],
    target_speeds: NDArray[np.float64],
) -> None:
    for zone in members.numbers:
        worlds = _worlds(members, zone, side, side)
        begin_step(roads, worlds, discrete, meta_actions, target_speeds)


@kernel
def drive_on_each(
    members: Members, side: int, inserted: NDArray[np.float64], first_stop: int
) -> None:
    for zone in members.numbers:
        drive_on(inserted, first_stop, _worlds(members, zone, side, side))


@kernel
def detect_each(members: Members, side: int, roads: RoadArrays, dt: float) -> None:
    for zone in members.numbers:
        worlds = _worlds(members, zone, side, side)
        detect(
            roads.lane_place,
            roads.places,
            worlds.rows,
            worlds.num_owned,
            worlds.ticks,
            dt,
            worlds.detected_s,
        )


@kernel
def sense_each(
    members: Members,
    side: int,
    roads: RoadArrays,
    plans: NDArray[np.void],
    travel: Travel,
    scratch_grid: Grid,
    sensors: Sensors,
    tick_s: float,
    ticks_per_step: int,
    chosen: NDArray[np.bool_],
    outputs: Outputs,
) -> None:
    for n in range(members.numbers.size):
        worlds = _worlds(members, members.numbers[n], side, side)
        grid = _grid(members.frames[n], scratch_grid)
        sense(roads, plans, travel, worlds, grid, sensors, tick_s, ticks_per_step, chosen, outputs)


@kernel
def credit_each(
    members: Members, side: int, rewards: NDArray[np.float32], chosen: NDArray[np.bool_]
) -> None:
    for zone in members.numbers:
        worlds = _worlds(members, zone, side, side)
        credit(worlds.rows, worlds.num_owned, rewards, chosen)


@kernel
def choose_goals_each(
    members: Members,
    side: int,
    next_side: int,
    demand: Demand,
    roads: RoadArrays,
    travel: Travel,
    num_goals: int,
    gate: Gate,
    dt: float,
) -> None:
    for zone in members.numbers:
        worlds = _worlds(members, zone, side, next_side)
        choose_goals(demand, roads, travel, num_goals, gate, worlds, dt)


@kernel
def rank_lanes_each(
    members: Members,
    side: int,
    next_side: int,
    roads: RoadArrays,
    travel: Travel,
    gate: Gate,
    scratch: Scratch,
) -> None:
    for zone in members.numbers:
        worlds = _worlds(members, zone, side, next_side)
        rank_lanes(roads, travel, members.zones, zone, gate, worlds, scratch)


@kernel
def propose_each(
    members: Members,
    side: int,
    next_side: int,
    demand: Demand,
    roads: RoadArrays,
    travel: Travel,
    gate: Gate,
    scratch: Scratch,
) -> None:
    for zone in members.numbers:
        worlds = _worlds(members, zone, side, next_side)
        propose(demand, roads, travel, members.zones, zone, gate, worlds, scratch)


@kernel
def admit_each(members: Members, side: int, next_side: int, gate: Gate) -> None:
    for zone in members.numbers:
        worlds = _worlds(members, zone, side, next_side)
        admit(members.zones, members.halo, zone, gate, worlds)


@kernel
def retire_each(members: Members, side: int, gate: Gate, ticks_per_step: int) -> None:
    """Let the agents of each zone whose trip has ended `leave`."""
    for zone in members.numbers:
        worlds = _worlds(members, zone, side, side)
        leave(gate, worlds, worlds.rows, DRIVER_AGENT, ticks_per_step)


@kernel
def forget_each(members: Members, side: int, gate: Gate) -> None:
    for zone in members.numbers:
        worlds = _worlds(members, zone, side, side)
        drop_ghosts(gate, worlds, worlds.rows)
