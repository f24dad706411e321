"""Drawing an episode's orders: each random number is a function of key, element and vehicle."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary import log1p
from cavmarl.core.math.elementary_arrays import cos_all, log1p_all
from cavmarl.core.math.rng import STREAM_DEMAND, fill_uniform
from cavmarl.traffic.demand.demand_records import FLOW_PROBABILITY, FLOW_REGULAR

DRAW_TIME = STREAM_DEMAND
DRAW_TYPE = STREAM_DEMAND + 1
DRAW_ROUTE = STREAM_DEMAND + 2
DRAW_REROUTE = STREAM_DEMAND + 3
DRAW_SPEED_FACTOR = STREAM_DEMAND + 4

SPEED_FACTOR_TRIES = 8

_CHUNK = 4096


def chances(
    key: int, elements: NDArray[np.integer], numbers: NDArray[np.integer], stream: int
) -> NDArray[np.float64]:
    """Return numbers (n,) in [0, 1), one for each vehicle of an element."""
    drawn = np.empty(len(elements))
    fill_uniform(np.uint64(key), elements.astype(np.int64), numbers.astype(np.int64), stream, drawn)
    return drawn


def departures_ms(
    elements: NDArray[np.void], key: int, begin_ms: int, end_ms: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return when vehicles of elements depart within [begin_ms, end_ms).

    The three arrays (n,) are ELEMENT row, number of the vehicle in its flow, and time in ms.
    """
    regular = _regular(elements, begin_ms, end_ms)
    parts = [regular]
    for row in np.flatnonzero(elements["pattern"] != FLOW_REGULAR):
        flow = elements[row]
        times = _random(flow, key, int(row), min(int(flow["end_ms"]), end_ms))
        number = np.arange(len(times))
        kept = times >= begin_ms
        parts.append((np.full(kept.sum(), row), number[kept], times[kept]))
    rows, numbers, times = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return rows, numbers, times


def _regular(
    elements: NDArray[np.void], begin_ms: int, end_ms: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    start, period = elements["begin_ms"], np.maximum(elements["period_ms"], 1)
    first = np.maximum(-((start - begin_ms) // period), 0)
    span = np.minimum(elements["end_ms"], end_ms) - start
    beyond = np.minimum(-(-span // period), elements["number"])
    # A flow with period 0 departs all at once.
    at_once = (elements["period_ms"] == 0) & (start >= begin_ms) & (start < end_ms)
    beyond = np.where(elements["period_ms"] == 0, at_once * elements["number"], beyond)
    first = np.where(elements["period_ms"] == 0, 0, first)
    count = np.maximum(beyond - first, 0) * (elements["pattern"] == FLOW_REGULAR)
    rows = np.repeat(np.arange(len(elements)), count)
    before = np.cumsum(count) - count
    numbers = np.arange(len(rows)) - before[rows] + first[rows]
    return rows, numbers, start[rows] + numbers * elements["period_ms"][rows]


def _random(flow: np.void, key: int, row: int, end_ms: int) -> NDArray[np.int64]:
    """Return times as sums of random gaps after the start, one draw per vehicle.

    Gaps are exponential, -ln(1 - u) / rate; or they are numbers of trials, one in each full second
    whatever the step: with probability p, 1 + floor(ln(1 - u) / ln(1 - p)) until a success.
    """
    trials = flow["pattern"] == FLOW_PROBABILITY
    rate, wanted = float(flow["rate"]), int(flow["number"])
    begin = int(flow["begin_ms"])
    at = float((-(-begin // 1000) - 1) * 1000 if trials else begin)
    decay = (-math.inf if rate == 1.0 else log1p(-rate)) if trials else -rate
    times: list[NDArray[np.float64]] = [np.empty(0)]
    drawn = 0
    while at < end_ms and drawn < wanted:
        numbers = np.arange(drawn, drawn + _CHUNK)
        gaps = log1p_all(-chances(key, np.full(_CHUNK, row), numbers, DRAW_TIME)) / decay
        gaps = np.floor(gaps) + 1.0 if trials else gaps
        times.append(at + np.cumsum(gaps * 1000.0))
        at = float(times[-1][-1])
        drawn += _CHUNK
    found = np.floor(np.concatenate(times)[:wanted] + 0.5)
    return found[found < end_ms].astype(np.int64)


def speed_factors(
    types: NDArray[np.void], orders: NDArray[np.void], key: int
) -> NDArray[np.float64]:
    """Return the speed factors (n,) of ORDER (n,): given, or normally distributed by their type.

    As in SUMO, a number beyond the type's bounds is drawn again; after `SPEED_FACTOR_TRIES` it is
    clipped.
    """
    kind = types[orders["vtype"]]
    low, high = kind["min_speed_factor"], kind["max_speed_factor"]
    drawn = np.full(len(orders), np.nan)
    for attempt in range(SPEED_FACTOR_TRIES):
        # Box, Muller: "A note on the generation of random normal deviates", 1958.
        stream = DRAW_SPEED_FACTOR + 2 * attempt
        radius = chances(key, orders["element"], orders["number"], stream)
        angle = chances(key, orders["element"], orders["number"], stream + 1)
        normal = np.sqrt(-2.0 * log1p_all(-radius)) * cos_all(2.0 * np.pi * angle)
        value = kind["speed_factor"] + kind["speed_dev"] * normal
        last = attempt == SPEED_FACTOR_TRIES - 1
        fits = np.isnan(drawn) & (last | ((value >= low) & (value <= high)))
        drawn[fits] = np.clip(value, low, high)[fits]
    return np.where(np.isnan(orders["speed_factor"]), drawn, orders["speed_factor"])
