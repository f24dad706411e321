"""The phases of a tick, each as one kernel for all zones of a process, in the order of a tick.

Committed rows have the state at the start of the tick, and next rows the state at its end.
"""

from __future__ import annotations

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import DepartureQueue, Worlds, ZoneState
from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    DRIVER_EXTERNAL,
    DRIVER_LEARNED,
    DRIVER_SUMO,
)
from cavmarl.rewards.kernels.reward import credit
from cavmarl.roads.kernels.signal_phases import detect
from cavmarl.sensors.kernels.frame_stacks import fill_stacks
from cavmarl.sensors.kernels.observe_optional import observe_optional
from cavmarl.sensors.kernels.observing_messages import observe_messages
from cavmarl.sensors.kernels.sense import sense
from cavmarl.shards.kernels.learned_driving import drive_by_network
from cavmarl.shards.kernels.world_phases import advance, begin_step, resolve
from cavmarl.shards.kernels.zone_loop import COMMITTED, NEXT, Members, for_each_zone
from cavmarl.traffic.kernels.admission import admit, propose, rank_lanes
from cavmarl.traffic.kernels.demand_generator import choose_goals
from cavmarl.traffic.kernels.leaving import drop_ghosts, leave
from cavmarl.zones.kernels.ghost_exchange import gather
from cavmarl.zones.kernels.zone_lookup import Halo, ZoneArrays


@kernel
def leave_background(departures: DepartureQueue, worlds: Worlds) -> None:
    """Move background vehicles of the next rows whose trip is over to the departure queue."""
    leave(departures, worlds, worlds.next_rows, DRIVER_BACKGROUND, 1)
    leave(departures, worlds, worlds.next_rows, DRIVER_LEARNED, 1)


@kernel
def dismiss(departures: DepartureQueue, worlds: Worlds) -> None:
    """Move vehicles of the next rows that SUMO or the caller removes to the departure queue."""
    leave(departures, worlds, worlds.next_rows, DRIVER_SUMO, 0)
    leave(departures, worlds, worlds.next_rows, DRIVER_EXTERNAL, 0)


@kernel
def retire(departures: DepartureQueue, worlds: Worlds, ticks_per_step: int) -> None:
    """Move the vehicles of agents whose trip has ended to the departure queue."""
    leave(departures, worlds, worlds.rows, DRIVER_AGENT, ticks_per_step)


@kernel
def forget(departures: DepartureQueue, worlds: Worlds) -> None:
    """Drop the ghosts of vehicles that `retire` has removed."""
    drop_ghosts(departures, worlds, worlds.rows)


@kernel
def gather_ghosts(
    zones: ZoneArrays,
    halo: Halo,
    touching_m: float,
    border_m: float,
    zoned: ZoneState,
    next_side: int,
    zone: int,
) -> None:
    """Renew the ghosts of a zone in all worlds. Zones may run this at the same time."""
    for w in range(zoned.num_owned.shape[1]):
        gather(zones, halo, touching_m, border_m, zoned, next_side, zone, w)


begin_step_each = for_each_zone(begin_step)
drive_by_network_each = for_each_zone(drive_by_network)
advance_each = for_each_zone(advance)
choose_goals_each = for_each_zone(choose_goals)
leave_background_each = for_each_zone(leave_background)
dismiss_each = for_each_zone(dismiss)
gather_ghosts_each = for_each_zone(gather_ghosts)
resolve_each = for_each_zone(resolve)
rank_lanes_each = for_each_zone(rank_lanes)
propose_each = for_each_zone(propose)
admit_each = for_each_zone(admit)
detect_each = for_each_zone(detect)
sense_each = for_each_zone(sense)
observe_optional_each = for_each_zone(observe_optional)
observe_messages_each = for_each_zone(observe_messages)
fill_stacks_each = for_each_zone(fill_stacks)
credit_each = for_each_zone(credit)
retire_each = for_each_zone(retire)
forget_each = for_each_zone(forget)


@kernel
def turn(members: Members, ticks_in_order: int) -> None:
    """In a tick that sorts rows, choose the other half of `ZoneState.rows` for the next rows."""
    if members.common.ticks[0] % ticks_in_order == 0:
        members.sides[NEXT] = 1 - members.sides[COMMITTED]


@kernel
def commit(members: Members) -> None:
    """Make the next rows the committed rows."""
    members.sides[COMMITTED] = members.sides[NEXT]


@kernel
def count_rows(zoned: ZoneState) -> None:
    """Set the numbers of rows in an undivided world, which has no ghosts."""
    for zone in range(zoned.num_owned.shape[0]):
        for w in range(zoned.num_owned.shape[1]):
            zoned.num_rows[zone, w] = zoned.num_near[zone, w] = zoned.num_owned[zone, w]
