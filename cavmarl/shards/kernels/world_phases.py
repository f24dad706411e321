"""The phases of one tick over W worlds: decisions and motion, contacts, suggested actions.

Drivers decide from the committed rows only; afterwards each row moves to the next tick. No phase
depends on the order of rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.compiled.prefetch import SOON, prefetch
from cavmarl.core.math.neighbors import Grid
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records.arrays import LaneGrid, RoadArrays, Scratch, TripTables, Worlds
from cavmarl.core.records.codes import (
    ACTION_FASTER,
    ACTION_IDLE,
    ACTION_LANE_LEFT,
    ACTION_LANE_RIGHT,
    ACTION_SLOWER,
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    DRIVER_LEARNED,
    DRIVER_SCRIPTED,
    EVENT_ARRIVED,
    EVENT_COLLIDED,
    EVENT_OUT_OF_TIME,
    EVENTS_THAT_END,
)
from cavmarl.core.records.rows import is_lost
from cavmarl.driving.kernels.drivers import decide
from cavmarl.driving.kernels.junctions.approach import register_links
from cavmarl.driving.kernels.junctions.gaps import STOOD_S
from cavmarl.driving.kernels.junctions.junctions import note_stop
from cavmarl.driving.kernels.lanes.lane_choice import needed_change
from cavmarl.driving.kernels.lanes.lane_index import index_lanes
from cavmarl.driving.kernels.lanes.route_following import own_step
from cavmarl.driving.kernels.motion.contacts import find_contacts
from cavmarl.driving.kernels.motion.highway_control import speed_control
from cavmarl.driving.kernels.motion.motion import move_agent, move_background
from cavmarl.driving.kernels.motion.scripted_rows import follow_script
from cavmarl.driving.kernels.motion.steering import nearest_speed, steer_to_lane, take_meta_action
from cavmarl.roads.kernels.lanes_now import plans_of, roads_in, shares_lanes
from cavmarl.zones.kernels.zone_lookup import is_inside, note_outer


@kernel
def begin_step(
    roads: RoadArrays,
    worlds: Worlds,  # outputs: the rows of agents
    discrete: bool,  # whether actions are meta-actions
    meta_actions: NDArray[np.int64],  # (W, A), ACTION_*; not read for continuous actions
    target_speeds: NDArray[np.float64],  # m/s, ascending
) -> None:
    """Clear the sums of the step and, with discrete actions, set the controllers' targets."""
    for w in range(worlds.ticks.shape[0]):
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            row["events"] = 0
            row["step_to_go"] = row["to_go"]
            row["step_jerk"] = 0.0
            if discrete and row["driver"] == DRIVER_AGENT:
                take_meta_action(roads, row, meta_actions[w, row["agent"]], target_speeds)


@kernel
def _any_driver(rows: NDArray[np.void], num: int, driver: int) -> bool:
    for i in range(num):
        if rows[i]["driver"] == driver:
            return True
    return False


@kernel
def _keep_order(owned: int, scratch: Scratch) -> None:
    """Keep the order of the owned rows."""
    for i in range(owned):
        scratch.order[i] = i


@kernel
def _order_by_lane(roads: RoadArrays, rows: NDArray[np.void], owned: int, scratch: Scratch) -> None:
    """Order the owned rows by lane, so that neighbours on the road are neighbours in memory."""
    found = 0
    for i in range(owned):
        # Scripted vehicles may be in several lists, or in none.
        if rows[i]["driver"] == DRIVER_SCRIPTED or is_lost(rows[i]):
            scratch.order[found] = i
            found += 1
    for k in range(scratch.lane_start[roads.lanes.shape[0]]):
        entry = scratch.entries[k]
        if not entry["side"] and entry["row"] < owned:
            scratch.order[found] = entry["row"]
            found += 1


@inlined_kernel
def _delay(
    pending: NDArray[np.float64], w: int, agent: int, tick: int, throttle: float, steering: float
) -> tuple[float, float]:
    """Append an agent's command to the delayed commands, and return the due command."""
    slots = pending.shape[2]
    last = (tick + slots - 1) % slots
    pending[w, agent, last, 0] = throttle
    pending[w, agent, last, 1] = steering
    due = tick % slots
    return pending[w, agent, due, 0], pending[w, agent, due, 1]


@inlined_kernel
def _drive_agent(
    roads: RoadArrays,
    plans: NDArray[np.void],
    travel: TripTables,
    lane_grid: LaneGrid,
    worlds: Worlds,
    w: int,
    row: np.void,
    commands: NDArray[np.float64],
    discrete: bool,
    accel_limit: float,
    steering_limit: float,
    dt: float,
) -> None:
    """Move an agent's vehicle by its command or by the controllers, unless its trip is over."""
    if row["events"] & EVENTS_THAT_END:
        row["tick"] += 1
        return
    note_stop(roads, plans, row, worlds.signal_phase[w])
    kind = travel.types[row["vtype"]]
    throttle = commands[w, row["agent"], 0]
    steering = commands[w, row["agent"], 1]
    if discrete:
        throttle = speed_control(row["speed"], row["target_speed"])
        steering = steer_to_lane(roads, plans, row, row["target_lane"], kind["wheelbase"])
    throttle = clamp(throttle, -accel_limit, accel_limit)
    steering = clamp(steering, -steering_limit, steering_limit)
    throttle, steering = _delay(
        worlds.pending, w, row["agent"], worlds.ticks[w], throttle, steering
    )
    move_agent(roads, plans, lane_grid, row, kind, throttle, steering, worlds.signal_phase[w], dt)
    if row["due"] >= 0 and row["tick"] >= row["due"]:
        row["events"] |= EVENT_OUT_OF_TIME
    # The indicator is automatic: drivers behind make room for a vehicle that has to change lanes.
    row["blinker"] = needed_change(roads, travel, row, travel.steps[own_step(roads, row)])


@inlined_kernel
def _drive_learned(
    roads: RoadArrays,
    plans: NDArray[np.void],
    travel: TripTables,
    lane_grid: LaneGrid,
    phase: NDArray[np.int32],
    row: np.void,
    dt: float,
) -> bool:
    """Move a vehicle by the commands of its network; return whether its trip is over.

    The trip also ends in the tick after a contact, off the road and at the time limit.
    """
    row["events"] = 0
    if row["hit"] >= 0:
        row["events"] = EVENT_COLLIDED
        row["tick"] += 1
        return True
    note_stop(roads, plans, row, phase)
    kind = travel.types[row["vtype"]]
    move_agent(roads, plans, lane_grid, row, kind, row["throttle"], row["steering"], phase, dt)
    if row["due"] >= 0 and row["tick"] >= row["due"]:
        row["events"] |= EVENT_OUT_OF_TIME
    row["blinker"] = needed_change(roads, travel, row, travel.steps[own_step(roads, row)])
    is_over: bool = row["events"] & EVENTS_THAT_END != 0
    return is_over


@inlined_kernel
def _fetch_lanes(roads: RoadArrays, rows: NDArray[np.void], k: int, scratch: Scratch) -> None:
    """Prefetch the lanes of the next rows, and the first points of these lanes."""
    prefetch(roads.lanes, rows[scratch.order[k + SOON]]["lane"], 0)
    near = roads.lanes[rows[scratch.order[k + SOON // 2]]["lane"]]
    prefetch(roads.points, near["first_point"], 0)
    prefetch(roads.points, near["first_point"], 1)


@inlined_kernel
def _decide_in_background(
    roads: RoadArrays, travel: TripTables, worlds: Worlds, w: int, dt: float, scratch: Scratch
) -> bool:
    """Let the background vehicles of a world decide. Return whether there are any."""
    rows, num, owned = worlds.rows[w], worlds.num_rows[w], worlds.num_owned[w]
    if not _any_driver(rows, owned, DRIVER_BACKGROUND):
        return False
    step, phase = worlds.step[w], worlds.signal_phase[w]
    index_lanes(roads, travel, rows, num, scratch)
    register_links(roads, travel, rows, num, step, worlds.step_at[w], scratch)
    tick = worlds.ticks[w]
    decide(roads, travel, rows, owned, DRIVER_BACKGROUND, tick, dt, phase, step, scratch)
    return True


@inlined_kernel
def _drive_in_background(
    roads: RoadArrays,
    travel: TripTables,
    row: np.void,
    step: np.void,
    i: int,  # index of the decision
    dt: float,
    scratch: Scratch,
) -> int:
    """Move a background vehicle as decided. Return `EVENT_ARRIVED` if its trip is over, else 0."""
    row["events"] = 0
    row["hold"] = scratch.hold[i]
    row["blinker"] = scratch.blinker[i]
    if scratch.link_ahead[i] >= 0 and row["wait_s"] >= STOOD_S:
        row["stopped_at"] = scratch.link_ahead[i]
    accel, change = scratch.accel[i], scratch.lane_change[i]
    move_background(roads, travel, row, step, accel, change, dt)
    return row["events"] & EVENT_ARRIVED  # type: ignore[no-any-return]


@kernel
def advance(
    roads: RoadArrays,
    plans: NDArray[np.void],  # PLAN (V, goals, lanes); V as in `Worlds.lanes`
    travel: TripTables,
    lane_grid: LaneGrid,  # index of lanes by position
    worlds: Worlds,  # output: next_rows
    inner: NDArray[np.float64],  # the part of the zone that no other zone sees; see `Halo`
    scratch: Scratch,
    # (W, A, 2) throttle in m/s² and steering in rad of continuous actions
    commands: NDArray[np.float64],
    discrete: bool,  # whether controllers drive the agents, towards the targets of discrete actions
    accel_limit: float,  # limit of the agents' throttle, m/s²
    steering_limit: float,  # limit of the angle of the agents' front wheels, rad
    dt: float,  # length of the tick, s
    in_place: bool,  # whether `next_rows` is `rows`; if not, rows are sorted by lane
) -> int:  # number of background vehicles whose trip is over, in all worlds
    """Decide all controls from the committed rows, then move every owned row into `next_rows`."""
    arrived = 0
    for w in range(worlds.ticks.shape[0]):
        rows = worlds.rows[w]
        here = roads if shares_lanes(worlds.lanes) else roads_in(roads, worlds.lanes, w)
        step = worlds.step[w]
        owned = worlds.num_owned[w]
        drivers = _decide_in_background(here, travel, worlds, w, dt, scratch)
        if drivers and not in_place:
            _order_by_lane(here, rows, owned, scratch)
        else:
            _keep_order(owned, scratch)
        through = outer = touching = 0
        for k in range(owned):
            if k + SOON < owned:
                _fetch_lanes(here, rows, k, scratch)
            i = scratch.order[k]
            if not in_place:
                worlds.next_rows[w, k] = rows[i]
            row = worlds.next_rows[w, k]
            touching += row["hit"] >= 0
            if row["driver"] == DRIVER_BACKGROUND:
                through += _drive_in_background(here, travel, row, step[i], i, dt, scratch)
            elif row["driver"] == DRIVER_SCRIPTED:
                row["events"] = 0
                follow_script(here, travel, worlds.cues[w], row, dt)
            elif row["driver"] == DRIVER_LEARNED:
                own_plans = plans[plans_of(plans, row, w)]
                phase = worlds.signal_phase[w]
                through += _drive_learned(here, own_plans, travel, lane_grid, phase, row, dt)
            elif row["driver"] == DRIVER_AGENT:
                _drive_agent(
                    here,
                    plans[plans_of(plans, row, w)],
                    travel,
                    lane_grid,
                    worlds,
                    w,
                    row,
                    commands,
                    discrete,
                    accel_limit,
                    steering_limit,
                    dt,
                )
            if not is_inside(inner, row["x"], row["y"]):
                note_outer(worlds.outer[w, outer], row, k)
                outer += 1
        worlds.num_outer[w] = outer
        worlds.num_through[w] = through
        worlds.num_touching[w] = touching
        arrived += through
    return arrived


@kernel
def resolve(
    # outputs: events and hit of the owned next_rows; num_contacts increases for each vehicle
    # that begins to touch another vehicle
    worlds: Worlds,
    scratch: Scratch,
    grid: Grid,  # spatial index over the vehicles of one world, filled here if needed
) -> None:
    """Mark contacts in `next_rows`."""
    for w in range(worlds.ticks.shape[0]):
        rows = worlds.next_rows[w]
        touch = find_contacts(rows, worlds.num_near[w], grid, scratch.hit)
        if not touch and worlds.num_touching[w] == 0:
            continue
        for i in range(worlds.num_owned[w]):
            row = rows[i]
            other = scratch.hit[i]
            if other >= 0:
                if row["hit"] < 0:
                    worlds.num_contacts[w] += 1
                row["events"] |= EVENT_COLLIDED
            row["hit"] = other


@kernel
def suggest(
    roads: RoadArrays,
    plans: NDArray[np.void],  # PLAN (V, goals, lanes); V as in `Worlds.lanes`
    travel: TripTables,
    worlds: Worlds,  # input only
    scratch: Scratch,
    discrete: bool,  # whether to write meta-actions
    target_speeds: NDArray[np.float64],  # m/s, ascending; discrete only
    lookahead_s: float,  # time in which a target speed should be reached; discrete only
    dt: float,  # length of a step, for which an action applies, s
    # (W, A, 2) output: throttle in m/s² and steering in rad, or the meta-action in [..., 0];
    # values of absent agents do not change
    out: NDArray[np.float64],
) -> None:
    """Write the actions that the built-in driver would take for the agents."""
    for w in range(worlds.ticks.shape[0]):
        rows = worlds.rows[w]
        here = roads if shares_lanes(worlds.lanes) else roads_in(roads, worlds.lanes, w)
        owned = worlds.num_owned[w]
        phase = worlds.signal_phase[w]
        index_lanes(here, travel, rows, worlds.num_rows[w], scratch)
        step = worlds.step[w]
        register_links(here, travel, rows, worlds.num_rows[w], step, worlds.step_at[w], scratch)
        decide(here, travel, rows, owned, DRIVER_AGENT, worlds.ticks[w], dt, phase, step, scratch)
        for i in range(owned):
            row = rows[i]
            if row["driver"] != DRIVER_AGENT:
                continue
            agent = row["agent"]
            lane = here.lanes[row["lane"]]
            target = row["lane"]
            change = scratch.lane_change[i]
            if change > 0:
                target = lane["left"]
            elif change < 0:
                target = lane["right"]
            out[w, agent, 0] = scratch.accel[i]
            own_plans = plans[plans_of(plans, row, w)]
            out[w, agent, 1] = steer_to_lane(
                here, own_plans, row, target, travel.types[row["vtype"]]["wheelbase"]
            )
            if discrete:
                wanted = nearest_speed(
                    target_speeds, max(row["speed"] + scratch.accel[i] * lookahead_s, 0.0)
                )
                present = nearest_speed(target_speeds, row["target_speed"])
                out[w, agent, 0] = ACTION_IDLE
                if wanted > present:
                    out[w, agent, 0] = ACTION_FASTER
                elif wanted < present:
                    out[w, agent, 0] = ACTION_SLOWER
                elif change != 0:
                    out[w, agent, 0] = ACTION_LANE_LEFT if change > 0 else ACTION_LANE_RIGHT
