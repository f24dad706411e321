"""Draws an episode's orders: each random number is a function of key, element and vehicle."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary import log1p
from cavmarl.core.math.elementary_arrays import cos_all, log1p_all
from cavmarl.core.math.rng import STREAM_DEMAND, fill_uniform
from cavmarl.traffic.demand.demand_records import (
    FLOW_EXPONENTIAL,
    FLOW_PROBABILITY,
    FLOW_REGULAR,
    MAX_NUMBER,
)

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
    """Return random numbers (n,) in [0, 1), one for each vehicle of an element."""
    drawn = np.empty(len(elements))
    fill_uniform(np.uint64(key), elements.astype(np.int64), numbers.astype(np.int64), stream, drawn)
    return drawn


def departures_ms(
    elements: NDArray[np.void], key: int, begin_ms: int, end_ms: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the departures of elements within [begin_ms, end_ms).

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
    # All vehicles of a flow with period 0 depart at once.
    at_once = (elements["period_ms"] == 0) & (start >= begin_ms) & (start < end_ms)
    beyond = np.where(elements["period_ms"] == 0, at_once * elements["number"], beyond)
    first = np.where(elements["period_ms"] == 0, 0, first)
    count = np.maximum(beyond - first, 0) * (elements["pattern"] == FLOW_REGULAR)
    rows = np.repeat(np.arange(len(elements)), count)
    before = np.cumsum(count) - count
    numbers = np.arange(len(rows)) - before[rows] + first[rows]
    return rows, numbers, start[rows] + numbers * elements["period_ms"][rows]


def scaled_flows(elements: NDArray[np.void], scale: float) -> NDArray[np.void]:
    """Return ELEMENT (n,) with the flows of a demand that is multiplied by `scale`.

    As in SUMO, `scale` multiplies the (rounded) number of vehicles of a flow, and divides the
    flow's period. `copied` handles flows with a probability, and vehicles outside of flows.
    """
    found = elements.copy()
    regular = elements["flow"] & (elements["pattern"] == FLOW_REGULAR)
    for row in np.flatnonzero(regular):
        flow = found[row]
        period = int(flow["period_ms"])
        number = int(flow["number"])
        if period > 0:
            number = min(number, -(-int(flow["end_ms"] - flow["begin_ms"]) // period))
        flow["number"] = math.floor(number * scale + 0.5)
        if scale > 0.0:
            flow["period_ms"] = math.floor(period / scale)
            span = int(flow["number"]) * int(flow["period_ms"])
            flow["end_ms"] = int(flow["begin_ms"]) + max(span, 1)
    exponential = elements["pattern"] == FLOW_EXPONENTIAL
    found["rate"][exponential] *= scale
    limited = exponential & (elements["number"] < MAX_NUMBER)
    found["number"][limited] = np.floor(elements["number"][limited] * scale + 0.5)
    if scale == 0.0:
        found["number"] = 0
    return found


def copied(
    elements: NDArray[np.void],
    rows: NDArray[np.int64],
    numbers: NDArray[np.int64],
    times: NDArray[np.int64],
    scale: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return departures (m,) of a demand that is multiplied by `scale`; see `scaled_flows`.

    As in SUMO, k counts vehicles in each flow with a probability, and vehicles outside of flows.
    Vehicle k departs floor(scale) times, and once more if k · part mod 1000 < part, where `part` is
    the fraction of the scale in thousandths. In a flow, copies are numbered as further vehicles.
    Outside of flows, a departure has the number of the copy.

    `rows`, `numbers`, `times`: departures (n,) as in `departures_ms`.
    """
    whole, part = divmod(math.floor(scale * 1000.0 + 0.5), 1000)
    singles = np.cumsum(~elements["flow"]) - 1
    in_flow = elements["flow"][rows]
    done = in_flow & (elements["pattern"][rows] != FLOW_PROBABILITY)
    k = np.where(in_flow, numbers, singles[rows])
    count = np.where(done, 1, whole + (k % 1000 * part % 1000 < part))
    before = np.cumsum(count) - count
    copies = np.arange(int(count.sum())) - np.repeat(before, count)
    first = np.where(done, k, np.where(in_flow, k * whole + -(-k * part // 1000), 0))
    return np.repeat(rows, count), np.repeat(first, count) + copies, np.repeat(times, count)


def _random(flow: np.void, key: int, row: int, end_ms: int) -> NDArray[np.int64]:
    """Return times that are sums of random gaps after the start, with one draw per vehicle.

    Gaps are exponential, -ln(1 - u) / rate; or they are numbers of trials until a success, with one
    trial of probability p in each full second: 1 + floor(ln(1 - u) / ln(1 - p)).
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
    """Return the speed factors (n,) of ORDER (n,): given, or normally distributed by type.

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
