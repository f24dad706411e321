"""The part of a tick in which roadside units measure traffic and set speed limits.

All sums over vehicles are whole numbers, so they do not depend on the order or the owners of
vehicles. They include the ticks since the last decision, and give the density, flow and mean speed
of a section by Edie's definitions (1963).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.rows import is_off_lanes
from cavmarl.signals.kernels.green_choices import GREEN, KEEP, PREVIOUS, REFUSED, SINCE

# Columns of the sums (W, M, SUMS) of sections.
PRESENT = 0  # vehicles, summed over ticks
SPEED_MM = 1  # speeds in mm/s
LOST_PPM = 2  # 1 - speed / (limit of the map · the driver's factor), at least 0, in millionths
STANDING = 3  # vehicles slower than 0.1 m/s
SUMS = 4

STANDING_MPS = 0.1
# Scales of observations.
DENSITY_SCALE = 100.0  # vehicles per km and lane
FLOW_SCALE = 2500.0  # vehicles per h and lane
SPEED_SCALE = 40.0  # m/s
LOST_SCALE_S = 100.0  # scale of the reward term delay, in vehicle seconds
OF_SECTION = 4  # features of a section: density, flow, speed, share of stopped vehicles


class LimitPlaces(NamedTuple):
    """U units and M sections, for kernels."""

    section: NDArray[np.int32]  # (L,) section of each LANE; -1: not counted
    map_mps: NDArray[np.float64]  # (L,) limits of the map
    length_m: NDArray[np.float64]  # (M,) length of each section, summed over lanes


class LimitRules(NamedTuple):
    """The rules for choices and rewards."""

    decide: int  # ticks between decisions
    most_change: int  # largest change of a choice at a decision; 0: no limit
    num_choices: int  # C, number of limits to choose from
    dt: float
    weights: NDArray[np.float64]  # (T,) of LIMIT_TERMS


class LimitOutputs(NamedTuple):
    """State and outputs of U units; observations are made at decisions, and kept in between."""

    observations: NDArray[np.float32]  # (W, U, D)
    rewards: NDArray[np.float32]  # (W, U) 0 in steps that do not end an interval of decisions
    terms: NDArray[np.float32]  # (W, U, T)
    masks: NDArray[np.bool_]  # (W, U, C) choices that are allowed in the next step
    decides: NDArray[np.bool_]  # (W,) whether choices count in the next step
    # (W, U, HELD) as for signals (`signals.kernels.green_choices`): the previous and the present
    # choice, the tick of the last change, and the number of refused choices
    states: NDArray[np.int64]


@kernel
def choose_limits(
    rules: LimitRules,
    choices: NDArray[np.int64],  # (W, U) KEEP, or an index of a speed
    ticks: NDArray[np.int64],  # (W,)
    held: NDArray[np.int64],  # (W, U, HELD) updated
) -> None:
    """Apply the chosen limits, in worlds in which it is time for a decision."""
    for w in range(ticks.size):
        if ticks[w] % rules.decide != 0:
            continue
        for u in range(held.shape[1]):
            state, wanted = held[w, u], choices[w, u]
            state[PREVIOUS] = state[GREEN]
            if wanted == KEEP or wanted == state[GREEN]:
                continue
            if rules.most_change > 0 and abs(wanted - state[GREEN]) > rules.most_change:
                state[REFUSED] += 1
                continue
            state[GREEN] = wanted
            state[SINCE] = ticks[w]


@kernel
def count_sections(
    places: LimitPlaces,
    rows: NDArray[np.void],  # VEHICLE (2, k, W, C), see `ZoneState`
    sides: NDArray[np.int64],  # (2,) the first number is the half of `rows` with the committed rows
    num_owned: NDArray[np.int64],  # (k, W)
    chosen: NDArray[np.bool_],  # (W,) worlds in which a tick has ended
    sums: NDArray[np.int64],  # (W, M, SUMS) updated
) -> None:
    """Add the vehicles of a tick to the sums of their sections."""
    committed = rows[sides[0]]
    for zone in range(committed.shape[0]):
        for w in range(committed.shape[1]):
            if not chosen[w]:
                continue
            for i in range(num_owned[zone, w]):
                row = committed[zone, w, i]
                if is_off_lanes(row):
                    continue
                lane = row["lane"]
                if places.section[lane] < 0:
                    continue
                found = sums[w, places.section[lane]]
                speed = abs(row["speed"])
                desired = places.map_mps[lane] * max(row["speed_factor"], 1e-3)
                found[PRESENT] += 1
                found[SPEED_MM] += math.floor(speed * 1e3 + 0.5)
                found[LOST_PPM] += math.floor(max(1.0 - speed / desired, 0.0) * 1e6 + 0.5)
                found[STANDING] += speed < STANDING_MPS


@kernel
def observe_limits(
    places: LimitPlaces,
    rules: LimitRules,
    outputs: LimitOutputs,
    ticks: NDArray[np.int64],  # (W,)
    chosen: NDArray[np.bool_],  # (W,) worlds whose outputs are written
    rewarded: NDArray[np.bool_],  # (1,) whether an interval between decisions has ended
    sums: NDArray[np.int64],  # (W, M, SUMS) set to 0 at decisions
) -> None:
    """Write the allowed choices of the next step; at decisions also observations and rewards.

    An observation has the present choice in one-hot encoding, then for each section the means since
    the last decision: density, flow, speed, and the share of stopped vehicles.
    """
    for w in range(chosen.size):
        if not chosen[w]:
            continue
        decides = ticks[w] % rules.decide == 0
        outputs.decides[w] = decides
        for u in range(outputs.states.shape[1]):
            state = outputs.states[w, u]
            for choice in range(rules.num_choices):
                near = abs(choice - state[GREEN])
                is_near = rules.most_change == 0 or near <= rules.most_change
                outputs.masks[w, u, choice] = near == 0 or (decides and is_near)
            outputs.terms[w, u] = 0.0
            outputs.rewards[w, u] = 0.0
            if not decides:
                continue
            if rewarded[0]:
                _reward(rules, sums[w], state, outputs.terms[w, u], outputs.rewards[w], u)
            out = outputs.observations[w, u]
            out[:] = 0.0
            out[state[GREEN]] = 1.0
            for m in range(places.length_m.size):
                found = sums[w, m]
                part = out[rules.num_choices + m * OF_SECTION :]
                lane_km = places.length_m[m] * 1e-3
                present = found[PRESENT]
                if present == 0:
                    part[2] = 1.0
                    continue
                mean_mps = found[SPEED_MM] * 1e-3 / present
                per_km = present / rules.decide / lane_km
                part[0] = min(1.0, per_km / DENSITY_SCALE)
                part[1] = min(1.0, per_km * mean_mps * 3.6 / FLOW_SCALE)
                part[2] = min(1.0, mean_mps / SPEED_SCALE)
                part[3] = found[STANDING] / present
        if decides:
            sums[w] = 0


@kernel
def _reward(
    rules: LimitRules,
    sums: NDArray[np.int64],  # (M, SUMS) of a world
    state: NDArray[np.int64],  # (HELD,)
    terms: NDArray[np.float32],  # (T,) output
    rewards: NDArray[np.float32],  # (U,) output at u
    u: int,
) -> None:
    """Write the terms of a unit and their weighted sum."""
    lost = 0
    for m in range(sums.shape[0]):
        lost += sums[m, LOST_PPM]
    terms[0] = -lost * 1e-6 * rules.dt / LOST_SCALE_S
    terms[1] = -abs(state[GREEN] - state[PREVIOUS])
    total = 0.0
    for t in range(rules.weights.size):
        if rules.weights[t] != 0.0:
            total += rules.weights[t] * np.float64(terms[t])
    rewards[u] = total
