"""Sending of messages: identities, schedule and contents."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.geometry import wrap_angle
from cavmarl.core.math.walls import Walls
from cavmarl.core.records.arrays import RoadArrays, SharedState, ZoneState
from cavmarl.core.records.codes import CHOSEN_BY_AGENT, DRIVER_AGENT
from cavmarl.driving.kernels.motion.motion import STANDING_MPS
from cavmarl.roads.kernels.signal_overrides import NOT_OVERRIDDEN, overridden_state
from cavmarl.roads.kernels.signal_phases import program_at
from cavmarl.v2x.kernels.shown_states import note_shown
from cavmarl.v2x.kernels.v2x_channel import is_equipped, packet_word
from cavmarl.v2x.kernels.v2x_perception import visible
from cavmarl.v2x.kernels.v2x_records import (
    CAUSE_COLLISION,
    CAUSE_HARD_BRAKING,
    CAUSE_NONE,
    CAUSE_ROAD_CLOSED,
    CAUSE_STATIONARY,
    COUNT_OVERFLOW,
    COUNT_SENT,
    FIRST_CLOSED_ROAD,
    FIRST_ROADSIDE_ID,
    KIND_CAM,
    KIND_CPM,
    KIND_DENM,
    KIND_SPAT,
    Mail,
    Sending,
    V2xScratch,
)

# Conditions under which a due CAM is sent (ETSI EN 302 637-2, 6.1.3).
CAM_DISTANCE_M = 4.0
CAM_HEADING_RAD = math.radians(4.0)
CAM_SPEED_MPS = 0.5
CAM_AFTER_S = 1.0


@kernel
def gather(
    zoned: ZoneState, side: int, w: int, stations: NDArray[np.void], spare: NDArray[np.void]
) -> int:
    """List the vehicles of all zones of a world by id, and return their number.

    `side`: half of `ZoneState.rows` to read. `stations`: STATION (C,), written. `spare`: scratch
    of the same size.
    """
    num = 0
    for zone in range(zoned.num_owned.shape[0]):
        for i in range(zoned.num_owned[zone, w]):
            station = stations[num]
            station["id"] = zoned.rows[side, zone, w, i]["id"]
            station["zone"] = zone
            station["row"] = i
            num += 1
    width = 1
    while width < num:
        for begin in range(0, num, 2 * width):
            _merge(stations, begin, min(begin + width, num), min(begin + 2 * width, num), spare)
        for k in range(num):
            stations[k] = spare[k]
        width *= 2
    return num


@kernel
def _merge(
    stations: NDArray[np.void], begin: int, middle: int, end: int, spare: NDArray[np.void]
) -> None:
    """Merge two adjacent sorted runs into `spare`."""
    a = begin
    b = middle
    for k in range(begin, end):
        if b == end or (a < middle and stations[a]["id"] < stations[b]["id"]):
            spare[k] = stations[a]
            a += 1
        else:
            spare[k] = stations[b]
            b += 1


@kernel
def phase_left_s(
    roads: RoadArrays,
    controllers: NDArray[np.void],
    signal: int,
    phase: NDArray[np.int32],
    tick: int,
    sending: Sending,
) -> float:
    """Return the remaining time of the current phase in s; if actuated, the shortest possible time.

    A chosen green ends at the first decision after its minimum, or later.
    """
    time = tick * sending.dt_s
    program = roads.programs[program_at(roads, signal, time, sending.dt_s)]
    row = phase[signal]
    if program["controller"] >= 0:
        since = 1e-3 * controllers[program["controller"]]["since_ms"]
        left = float(max(since + 1e-3 * roads.phases[row]["min_ms"] - time, 0.0))
        if program["detector_gap_s"] == CHOSEN_BY_AGENT and roads.phases[row]["green"]:
            last = tick + math.ceil(left / sending.dt_s - 1e-6)
            decision = -(-last // sending.decide) * sending.decide
            return float((decision - tick) * sending.dt_s)
        return left
    left = -((time - program["offset_s"]) % program["cycle_s"])
    for earlier in range(program["first_phase"], row + 1):
        left += roads.phases[earlier]["duration_s"]
    return float(max(left, 0.0))


@kernel
def _open(
    mail: Mail, w: int, slot: int, sender: int, tick: int, x: float, y: float, kind: int, count: int
) -> int:
    """Begin a packet of `count` reports; return the index of its first report; -1: no room."""
    number = mail.num_packets[w, slot]
    first = mail.num_reports[w, slot]
    if number == mail.packets.shape[2] or first + count > mail.reports.shape[2]:
        mail.counts[w, COUNT_OVERFLOW] += 1
        return -1
    packet = mail.packets[w, slot, number]
    packet["sender"] = sender
    packet["tick"] = tick
    packet["x"] = x
    packet["y"] = y
    packet["word"] = packet_word(sender, tick, kind)
    packet["kind"] = kind
    packet["first"] = first
    packet["count"] = count
    mail.num_packets[w, slot] = number + 1
    mail.num_reports[w, slot] = first + count
    mail.counts[w, COUNT_SENT + kind] += 1
    return int(first)


@kernel
def _write_vehicle(
    report: np.void, row: np.void, sender: int, kind: int, code: int, tick: int, expires: int
) -> None:
    report["subject"] = row["id"]
    report["sender"] = sender
    report["tick"] = tick
    report["expires"] = expires
    report["kind"] = kind
    report["code"] = code
    report["x"] = row["x"]
    report["y"] = row["y"]
    report["z"] = row["z"]
    report["heading"] = row["heading"]
    report["speed"] = row["speed"]
    report["accel"] = row["accel"]
    report["yaw_rate"] = row["yaw_rate"]
    report["length"] = row["length"]
    report["width"] = row["width"]
    report["left_s"] = 0.0


@kernel
def _cause(row: np.void, sending: Sending) -> int:
    """Return the cause of the most severe event that a vehicle should report; 0: no event."""
    if row["hit"] >= 0:
        return CAUSE_COLLISION
    if row["accel"] <= -sending.hard_braking_mps2:
        return CAUSE_HARD_BRAKING
    if row["wait_s"] >= sending.stationary_s and abs(row["speed"]) < STANDING_MPS:
        return CAUSE_STATIONARY
    return CAUSE_NONE


@kernel
def _is_due(tick: int, station: int, period: int) -> bool:
    """Return whether a station sends in this tick; stations take turns by their numbers."""
    return period > 0 and (tick + station) % period == 0


@kernel
def _has_changed(row: np.void, last: np.void, tick: int, dt: float) -> bool:
    dx = row["x"] - last["x"]
    dy = row["y"] - last["y"]
    return bool(
        dx * dx + dy * dy > CAM_DISTANCE_M * CAM_DISTANCE_M
        or abs(wrap_angle(row["heading"] - last["heading"])) > CAM_HEADING_RAD
        or abs(row["speed"] - last["speed"]) > CAM_SPEED_MPS
        or (tick - last["tick"]) * dt >= CAM_AFTER_S - 0.5 * dt
    )


@kernel
def _store_cam(last: np.void, row: np.void, tick: int) -> None:
    last["id"] = row["id"]
    last["tick"] = tick
    last["x"] = row["x"]
    last["y"] = row["y"]
    last["heading"] = row["heading"]
    last["speed"] = row["speed"]


@kernel
def _send_cam(
    sending: Sending, mail: Mail, w: int, slot: int, row: np.void, vclass: int, tick: int
) -> None:
    first = _open(mail, w, slot, row["id"], tick, row["x"], row["y"], KIND_CAM, 1)
    if first >= 0:
        expires = tick + sending.memory_ticks
        report = mail.reports[w, slot, first]
        _write_vehicle(report, row, row["id"], KIND_CAM, vclass, tick, expires)


@kernel
def _send_event(
    sending: Sending, mail: Mail, w: int, slot: int, row: np.void, cause: int, tick: int
) -> None:
    first = _open(mail, w, slot, row["id"], tick, row["x"], row["y"], KIND_DENM, 1)
    if first >= 0:
        expires = tick + sending.denm_ticks
        _write_vehicle(
            mail.reports[w, slot, first], row, row["id"], KIND_DENM, cause, tick, expires
        )


@kernel
def _send_seen(
    sending: Sending,
    mail: Mail,
    w: int,
    slot: int,
    sender: int,
    x: float,
    y: float,
    num: int,
    types: NDArray[np.void],
    scratch: V2xScratch,
    tick: int,
) -> None:
    if num == 0:
        return
    first = _open(mail, w, slot, sender, tick, x, y, KIND_CPM, num)
    if first < 0:
        return
    for k in range(num):
        row = scratch.vehicles[scratch.seen[k]]
        report = mail.reports[w, slot, first + k]
        vclass = types[row["vtype"]]["vclass"]
        _write_vehicle(report, row, sender, KIND_CPM, vclass, tick, tick + sending.memory_ticks)


@kernel
def send_from_vehicles(
    sending: Sending,
    mail: Mail,
    w: int,
    slot: int,
    zoned: ZoneState,
    side: int,
    num: int,
    key: np.uint64,
    tick: int,
    types: NDArray[np.void],
    walls: Walls,
    scratch: V2xScratch,
) -> None:
    """Send all due packets of vehicles, by id."""
    known = 0
    num_next = 0
    for k in range(num):
        station = scratch.stations[k]
        row = zoned.rows[side, station["zone"], w, station["row"]]
        is_agent = row["driver"] == DRIVER_AGENT
        if not is_agent and not is_equipped(key, row["id"], sending.equipped):
            continue
        is_due = _is_due(tick, row["id"], sending.cam_period)
        if sending.cam_triggered:
            while known < mail.num_last[w] and mail.last_cams[w, known]["id"] < row["id"]:
                known += 1
            has_sent = known < mail.num_last[w] and mail.last_cams[w, known]["id"] == row["id"]
            if has_sent:
                last = mail.last_cams[w, known]
                is_due = is_due and _has_changed(row, last, tick, sending.dt_s)
                if not is_due:
                    scratch.next_cams[num_next] = last
                    num_next += 1
            if is_due:
                _store_cam(scratch.next_cams[num_next], row, tick)
                num_next += 1
        if is_due:
            _send_cam(sending, mail, w, slot, row, types[row["vtype"]]["vclass"], tick)
        cause = CAUSE_NONE
        if is_agent:
            cause = mail.declared[w, row["agent"]]
        if cause == CAUSE_NONE and _is_due(tick, row["id"], sending.denm_period):
            cause = _cause(row, sending)
        if cause != CAUSE_NONE:
            _send_event(sending, mail, w, slot, row, cause, tick)
        if _is_due(tick, row["id"], sending.cpm_period):
            seen = visible(
                scratch, k, row["x"], row["y"], row["z"],
                sending.cpm_range_m, sending.cpm_objects, walls, False,
            )  # fmt: skip
            _send_seen(
                sending, mail, w, slot, row["id"], row["x"], row["y"], seen, types, scratch, tick
            )
    for k in range(num_next):
        mail.last_cams[w, k] = scratch.next_cams[k]
    mail.num_last[w] = num_next


@kernel
def send_from_units(
    sending: Sending,
    mail: Mail,
    w: int,
    slot: int,
    roads: RoadArrays,
    common: SharedState,
    units: NDArray[np.void],
    types: NDArray[np.void],
    walls: Walls,
    scratch: V2xScratch,
) -> None:
    """Send all due packets of roadside units."""
    tick = common.ticks[w]
    phase = common.signal_phase[w]
    num_agents = mail.declared.shape[1] - units.size
    for k in range(units.size):
        unit = units[k]
        sender = FIRST_ROADSIDE_ID + k
        expires = tick + sending.memory_ticks
        cause = mail.declared[w, num_agents + k]
        if cause != CAUSE_NONE:
            first = _open(mail, w, slot, sender, tick, unit["x"], unit["y"], KIND_DENM, 1)
            if first >= 0:
                report = mail.reports[w, slot, first]
                _write_unit(report, unit, sender, KIND_DENM, cause, tick)
                report["subject"] = sender
                report["expires"] = tick + sending.denm_ticks
                closure = mail.closures[w, k]
                if cause == CAUSE_ROAD_CLOSED and closure[4] > 0.0:
                    report["subject"] = FIRST_CLOSED_ROAD + int(closure[4]) - 1
                    report["x"] = closure[0]
                    report["y"] = closure[1]
                    report["z"] = closure[2]
                    report["heading"] = closure[3]
        if _is_due(tick, k, sending.unit_cpm_period):
            seen = visible(
                scratch, -1, unit["x"], unit["y"], unit["z"],
                sending.unit_range_m, sending.cpm_objects, walls, True,
            )  # fmt: skip
            _send_seen(
                sending, mail, w, slot, sender, unit["x"], unit["y"], seen, types, scratch, tick
            )
        if _is_due(tick, k, sending.spat_period):
            first = _open(mail, w, slot, sender, tick, unit["x"], unit["y"], KIND_SPAT, 1)
            if first >= 0:
                report = mail.reports[w, slot, first]
                signal = unit["signal"]
                _write_unit(report, unit, sender, KIND_SPAT, phase[signal], tick)
                report["subject"] = signal
                report["expires"] = expires
                report["left_s"] = phase_left_s(
                    roads, common.controllers[w], signal, phase, tick, sending
                )
                if phase.size > roads.signals.shape[0]:
                    _write_overrides(report, roads, signal, phase)


@kernel
def _write_overrides(
    report: np.void, roads: RoadArrays, signal: int, phase: NDArray[np.int32]
) -> None:
    """Write the states that the caller shows at the links of a signal, if any."""
    for link in range(roads.links.shape[0]):
        shown = overridden_state(roads, link, phase)
        if roads.links[link]["signal"] == signal and shown != NOT_OVERRIDDEN:
            report["left_s"] = 0.0
            note_shown(report, roads.links[link]["signal_index"], shown)


@kernel
def _write_unit(
    report: np.void, unit: np.void, sender: int, kind: int, code: int, tick: int
) -> None:
    """Write a report on a roadside unit itself, with its position."""
    report["sender"] = sender
    report["tick"] = tick
    report["kind"] = kind
    report["code"] = code
    report["x"] = unit["x"]
    report["y"] = unit["y"]
    report["z"] = unit["z"]
    report["heading"] = 0.0
    report["speed"] = 0.0
    report["accel"] = 0.0
    report["yaw_rate"] = 0.0
    report["length"] = 0.0
    report["width"] = 0.0
    report["left_s"] = 0.0
