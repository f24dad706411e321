"""Signals: the present phase of fixed-time programs and of actuated programs.

Agents choose the phases of other programs; see `signals.kernels.green_choices`.

The phase of a fixed-time program is a function of the tick. An actuated program is SUMO's gap-based
control: a green phase is prolonged while vehicles follow one another over its detectors, up to its
maximum duration. Times are whole milliseconds, as in SUMO. The world stores the program's state:
the phase, its beginning, the time of the next check, and when each detector was last occupied.

Sources: SUMO's documentation, Simulation/Traffic Lights ("actuated"), and the behaviour of libsumo
    1.28.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import RoadArrays
from cavmarl.core.records.codes import CHOSEN_BY_AGENT
from cavmarl.core.records.rows import is_off_lanes
from cavmarl.roads.kernels.map_choice import map_of

# Maximum distance from a detector to the centre of a vehicle that occupied it in this tick.
DETECTOR_REACH_M = 30.0

SECOND_MS = 1000  # SUMO prolongs phases to whole seconds; first check after at least this time


@kernel
def detect(
    lane_place: NDArray[np.int32],
    places: NDArray[np.void],
    rows: NDArray[np.void],
    num_owned: NDArray[np.int64],
    ticks: NDArray[np.int64],
    dt: float,
    detected_s: NDArray[np.float64],
) -> None:
    """Record when vehicles were last on the detectors: now, or when a rear left during this tick.

    The latest time is kept, so the result does not depend on the order of rows or on their owners.

    `lane_place`: (L,) see `RoadArrays`. `places`: PLACE (num_places,). `rows`: VEHICLE (W, C), the
    committed rows of the tick. `num_owned`: (W,) number of rows to check. `detected_s`: (W, D),
    updated; set to 0 at a reset.
    """
    for w in range(ticks.size):
        if ticks[w] == 0:
            # As in SUMO, every detector counts as occupied at the start of the episode.
            detected_s[w] = 0.0
        for i in range(num_owned[w]):
            row = rows[w, i]
            if is_off_lanes(row):
                continue
            place = lane_place[row["lane"]]
            while place >= 0:
                at = places[place]
                ahead = row["s"] - at["s_m"]
                if abs(ahead) < DETECTOR_REACH_M:
                    _note(row, ahead, ticks[w] * dt, dt, at["detector"], detected_s[w])
                place = at["next"]


@kernel
def switch_signals(
    roads: RoadArrays,
    keys: NDArray[np.uint64],
    ticks: NDArray[np.int64],
    detected_s: NDArray[np.float64],
    dt: float,
    controllers: NDArray[np.void],
    signal_phase: NDArray[np.int32],
) -> None:
    """Set every signal to its phase at the worlds' present ticks. A repeated call changes nothing.

    Signals of maps that a world does not use show their first phase.

    `detected_s`: (W, D) latest times of detection, of all shards up to these ticks. `controllers`:
    CONTROLLER (W, num_controllers), updated. `signal_phase`: (W, num_signals), overwritten.
    """
    for w in range(ticks.size):
        time = ticks[w] * dt
        if controllers.shape[1] > 0:
            if ticks[w] == 0:
                _start(roads, controllers[w], dt)
            own_map = map_of(keys[w], roads.maps.shape[0])
            _control(roads, own_map, ticks[w], detected_s[w], dt, controllers[w])
        own = roads.maps[map_of(keys[w], roads.maps.shape[0])]
        first_signal = own["first_signal"]
        end_signal = first_signal + own["num_signals"]
        for k in range(roads.signals.shape[0]):
            if k < first_signal or k >= end_signal:
                signal_phase[w, k] = roads.programs[roads.signals[k]["program"]]["first_phase"]
                continue
            program = program_at(roads, k, time, dt)
            controller = roads.programs[program]["controller"]
            if controller >= 0:
                signal_phase[w, k] = controllers[w, controller]["phase"]
            else:
                signal_phase[w, k] = _fixed_phase(roads, program, time, dt)


@kernel
def program_at(roads: RoadArrays, k: int, time: float, dt: float) -> int:
    signal = roads.signals[k]
    program = signal["program"]
    for row in range(signal["first_switch"], signal["first_switch"] + signal["num_switches"]):
        if roads.switches[row]["at_s"] > time + 0.5 * dt:
            break
        program = roads.switches[row]["program"]
    return int(program)


@kernel
def _fixed_phase(roads: RoadArrays, program: int, time: float, dt: float) -> int:
    """Return the PHASE row of a fixed-time program at `time`."""
    row = roads.programs[program]
    left = (time - row["offset_s"]) % row["cycle_s"]
    phase = row["first_phase"]
    last = phase + row["num_phases"] - 1
    # Allow half a tick of slack, because sums of ticks are not exact.
    while phase < last and left + 0.5 * dt >= roads.phases[phase]["duration_s"]:
        left -= roads.phases[phase]["duration_s"]
        phase += 1
    return int(phase)


@kernel
def _start(roads: RoadArrays, controllers: NDArray[np.void], dt: float) -> None:
    """Reset every actuated program to the phase at its offset."""
    for program in range(roads.programs.shape[0]):
        controller = roads.programs[program]["controller"]
        if controller >= 0:
            state = controllers[controller]
            state["phase"] = _fixed_phase(roads, program, 0.0, dt)
            state["since_ms"] = 0
            state["next_ms"] = roads.phases[state["phase"]]["min_ms"]


@kernel
def _note(
    row: np.void,
    ahead: float,
    time: float,
    dt: float,
    detector: int,
    detected_s: NDArray[np.float64],
) -> None:
    """Record when a vehicle was on a detector; its centre is `ahead` m beyond the detector."""
    rear = ahead - 0.5 * row["length"]
    if ahead + 0.5 * row["length"] >= 0.0 and rear <= row["speed"] * dt:
        # The vehicle drove the whole tick at the speed at its end (semi-implicit Euler).
        since = rear / row["speed"] if rear > 0.0 else 0.0
        detected_s[detector] = max(detected_s[detector], time - since)


@kernel
def _control(
    roads: RoadArrays,
    own_map: int,
    tick: int,
    detected_s: NDArray[np.float64],
    dt: float,
    controllers: NDArray[np.void],
) -> None:
    """Run all checks of every actuated program that are due before the next tick."""
    now_ms = _milliseconds(tick * dt)
    end_ms = _milliseconds((tick + 1) * dt)
    rows = roads.maps[own_map]
    for program in range(rows["first_program"], rows["first_program"] + rows["num_programs"]):
        controller = roads.programs[program]["controller"]
        gap_s = roads.programs[program]["detector_gap_s"]
        if controller >= 0 and gap_s != CHOSEN_BY_AGENT:
            state = controllers[controller]
            while state["next_ms"] < end_ms:
                state["next_ms"] += _check(roads, state, detected_s, gap_s, now_ms)


@kernel
def _check(
    roads: RoadArrays,
    state: np.void,
    detected_s: NDArray[np.float64],
    detector_gap_s: float,
    now_ms: int,
) -> int:
    """Prolong the phase or switch to the next; return the time to the next check in ms."""
    phase = roads.phases[state["phase"]]
    lasted = now_ms - state["since_ms"]
    gap = math.inf
    if phase["green"] and lasted < phase["max_ms"]:
        gap = _gap(roads, phase, detected_s, now_ms)
    if gap < math.inf:
        # Prolong the phase until the last vehicle has driven from the detector to the stop line.
        more = max(phase["min_ms"] - lasted, _milliseconds(detector_gap_s - gap), 1)
        if more % SECOND_MS != 0:
            more = ((more + lasted) // SECOND_MS + 1) * SECOND_MS - lasted
        return int(min(more, phase["max_ms"] - lasted))
    if phase["following"] != state["phase"]:
        state["phase"] = phase["following"]
        state["since_ms"] = now_ms
        lasted = 0
    return int(max(SECOND_MS, roads.phases[state["phase"]]["min_ms"] - lasted))


@kernel
def _gap(roads: RoadArrays, phase: np.void, detected_s: NDArray[np.float64], now_ms: int) -> float:
    """Return the time in s since a detector of a phase was occupied; inf above its maximum gap."""
    gap = math.inf
    for k in range(phase["first_detector"], phase["first_detector"] + phase["num_detectors"]):
        detector = roads.phase_detectors[k]
        since = now_ms / SECOND_MS - detected_s[detector]
        if since < roads.detectors[detector]["max_gap_s"]:
            gap = min(gap, since)
    return gap


@kernel
def _milliseconds(seconds: float) -> int:
    return math.floor(seconds * 1e3 + 0.5)
