"""The kernel of the `messages` sensor: vehicles, events and the next signal from the inbox."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import cos_sin
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records.arrays import RoadArrays, Worlds
from cavmarl.core.records.codes import (
    CHOSEN_BY_AGENT,
    DRIVER_AGENT,
    SIGNAL_GREEN_MAJOR,
    SIGNAL_GREEN_MINOR,
)
from cavmarl.driving.kernels.junctions.signal_timing import soonest_choice
from cavmarl.roads.kernels.lanes_now import plans_of
from cavmarl.roads.kernels.signal_phases import program_at
from cavmarl.sensors.kernels.frame_stacks import newest_frame
from cavmarl.v2x.kernels.shown_states import phase_of, shown_at
from cavmarl.v2x.kernels.v2x_records import (
    CAUSE_COLLISION,
    CAUSE_HARD_BRAKING,
    CAUSE_STATIONARY,
    KIND_CAM,
    Mail,
)

OBJECT_FEATURES = 11
EVENT_FEATURES = 8
SPEED_SCALE = 40.0  # m/s
ACCEL_SCALE = 10.0  # m/s²
LENGTH_SCALE = 20.0  # m
AGE_SCALE_S = 1.0
EVENT_AGE_SCALE_S = 10.0
SOON_S = 5.0  # a change after this time has a soonness of 0.5
SIGNAL_RANGE_M = 300.0  # distance within which the next signal is searched for
SIGNAL_FEATURES = 4


@kernel
def _unit(number: float) -> np.float32:
    return np.float32(clamp(number, -1.0, 1.0))


@kernel
def _observe_place(
    report: np.void, row: np.void, cos: float, sin: float, scale_m: float, out: NDArray[np.float32]
) -> None:
    dx = report["x"] - row["x"]
    dy = report["y"] - row["y"]
    out[0] = 1.0
    out[1] = _unit((dx * cos + dy * sin) / scale_m)
    out[2] = _unit((dy * cos - dx * sin) / scale_m)


@kernel
def _observe_object(
    report: np.void,
    row: np.void,
    cos: float,
    sin: float,
    scale_m: float,
    tick_s: float,
    out: NDArray[np.float32],
) -> None:
    _observe_place(report, row, cos, sin, scale_m, out)
    turned = report["heading"] - row["heading"]
    turned_cos, turned_sin = cos_sin(turned)
    out[3] = _unit((report["speed"] * turned_cos - row["speed"]) / SPEED_SCALE)
    out[4] = _unit(report["speed"] * turned_sin / SPEED_SCALE)
    out[5] = _unit(turned_cos)
    out[6] = _unit(turned_sin)
    out[7] = _unit(report["accel"] / ACCEL_SCALE)
    out[8] = _unit(report["length"] / LENGTH_SCALE)
    out[9] = _unit((row["tick"] - report["tick"]) * tick_s / AGE_SCALE_S)
    out[10] = 1.0 if report["kind"] == KIND_CAM else 0.0


@kernel
def _observe_event(
    report: np.void,
    row: np.void,
    cos: float,
    sin: float,
    scale_m: float,
    tick_s: float,
    out: NDArray[np.float32],
) -> None:
    """Write position, age and cause of an event."""
    _observe_place(report, row, cos, sin, scale_m, out)
    out[3] = _unit((row["tick"] - report["tick"]) * tick_s / EVENT_AGE_SCALE_S)
    if report["code"] == CAUSE_COLLISION:
        out[4] = 1.0
    elif report["code"] == CAUSE_HARD_BRAKING:
        out[5] = 1.0
    elif report["code"] == CAUSE_STATIONARY:
        out[6] = 1.0
    else:
        out[7] = 1.0


@kernel
def _next_signal(roads: RoadArrays, plans: NDArray[np.void], row: np.void) -> tuple[int, float]:
    """Return the first link with a signal on a vehicle's route, or -1, and its distance in m."""
    lane = row["lane"]
    distance = -row["s"]
    while True:
        distance += roads.lanes[lane]["length_m"]
        step = plans[row["goal"], lane]
        if distance > SIGNAL_RANGE_M or step["next"] < 0:
            return -1, distance
        if step["link"] >= 0 and roads.links[step["link"]]["signal"] >= 0:
            return int(step["link"]), distance
        lane = step["next"]


@kernel
def _observe_signal(
    roads: RoadArrays,
    link: int,
    signals: NDArray[np.void],
    tick: int,
    tick_s: float,
    timing: bool,
    distance_m: float,
    out: NDArray[np.float32],
) -> None:
    """Write the last message received from the roadside unit at a link, if any."""
    for k in range(signals.size):
        report = signals[k]
        if report["sender"] < 0:
            return
        if report["subject"] == roads.links[link]["signal"]:
            age_s = (tick - report["tick"]) * tick_s
            index = roads.links[link]["signal_index"]
            letter = shown_at(report, index)
            is_shown = letter >= 0
            if not is_shown:
                letter = roads.phase_states[roads.phases[phase_of(report)]["first_state"] + index]
            out[0] = 1.0
            if letter == SIGNAL_GREEN_MAJOR or letter == SIGNAL_GREEN_MINOR:
                out[1] = 1.0
            left_s = report["left_s"] - age_s
            out[2] = _soonness(left_s)
            out[3] = _unit(age_s / AGE_SCALE_S)
            if timing:
                part = out[SIGNAL_FEATURES:]
                part[0] = _unit(distance_m / SIGNAL_RANGE_M)
                if not is_shown:
                    program = program_at(roads, report["subject"], tick * tick_s, tick_s)
                    _observe_timing(roads, program, phase_of(report), index, left_s, part)
            return


@kernel
def _observe_timing(
    roads: RoadArrays, program: int, row: int, index: int, left_s: float, out: NDArray[np.float32]
) -> None:
    """Write the times of the next two changes between green and another state of a link.

    `row`: PHASE row that ends in `left_s` s. The receiver knows the program and, for actuated
    phases, the minimum duration. For greens that agents or controllers choose, it knows only the
    earliest time of the next change.
    """
    plan = roads.programs[program]
    first, count = plan["first_phase"], plan["num_phases"]
    if row < first or row >= first + count:
        return
    if plan["detector_gap_s"] == CHOSEN_BY_AGENT:
        change_s = soonest_choice(roads, plan, row, index, left_s, True)
        if change_s < math.inf:
            out[1] = _soonness(change_s)
        return
    found, now = 0, _is_green(roads, row, index)
    for _ in range(2 * count):
        if plan["controller"] >= 0:
            row = roads.phases[row]["following"]
            lasts_s = 1e-3 * roads.phases[row]["min_ms"]
        else:
            row = row + 1 if row + 1 < first + count else first
            lasts_s = roads.phases[row]["duration_s"]
        if _is_green(roads, row, index) != now:
            now = not now
            found += 1
            out[found] = _soonness(left_s)
            if found == 2:
                return
        left_s += lasts_s


@kernel
def _is_green(roads: RoadArrays, row: int, index: int) -> bool:
    letter = roads.phase_states[roads.phases[row]["first_state"] + index]
    return bool(letter == SIGNAL_GREEN_MAJOR or letter == SIGNAL_GREEN_MINOR)


@kernel
def _soonness(left_s: float) -> np.float32:
    return np.float32(SOON_S / (SOON_S + max(left_s, 0.0)))


@kernel
def observe_messages(
    roads: RoadArrays,
    plans: NDArray[np.void],
    worlds: Worlds,
    mail: Mail,
    at: int,
    objects: int,
    events: int,
    signal: bool,
    timing: bool,
    scale_m: float,
    tick_s: float,
    stack: int,
    chosen: NDArray[np.bool_],
    observations: NDArray[np.float32],
) -> None:
    """Write the inboxes of the owned agents of the chosen worlds.

    `mail`: the inboxes. `at`: index of the sensor's part in a frame. `objects`, `events`: number of
    vehicles and events. `signal`: whether to write the next signal. `timing`: whether to write the
    signal's times. `scale_m`: distance that is scaled to 1. `observations`: (W, A, D); the sensor's
    part of the newest frame must be 0 before.
    """
    for w in range(chosen.size):
        if not chosen[w]:
            continue
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if row["driver"] != DRIVER_AGENT:
                continue
            agent = row["agent"]
            seen = observations[w, agent]
            out = seen[newest_frame(seen, stack) + at :]
            cos, sin = cos_sin(row["heading"])
            for k in range(objects):
                report = mail.objects[w, agent, k]
                if report["sender"] < 0:
                    break
                part = out[k * OBJECT_FEATURES :]
                _observe_object(report, row, cos, sin, scale_m, tick_s, part)
            out = out[objects * OBJECT_FEATURES :]
            for k in range(events):
                report = mail.events[w, agent, k]
                if report["sender"] < 0:
                    break
                part = out[k * EVENT_FEATURES :]
                _observe_event(report, row, cos, sin, scale_m, tick_s, part)
            if signal:
                own_plans = plans[plans_of(plans, row, w)]
                link, distance_m = _next_signal(roads, own_plans, row)
                if link >= 0:
                    part = out[events * EVENT_FEATURES :]
                    inbox = mail.signals[w, agent]
                    _observe_signal(
                        roads, link, inbox, row["tick"], tick_s, timing, distance_m, part
                    )
