"""Raw values of an evaluation as records, their CSV files, and the outline of the map."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.terms import TERMS
from cavmarl.core.math.elementary import hypot
from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.roads.network import CARS, RoadNetwork

Rows = NDArray[np.void]

METRICS_VERSION: Final = 2  # raise it whenever the meaning of a column or a metric changes

TOLERANCE_M = 0.5  # largest deviation of an outline from the lane's centre


def reward_column(term: str) -> str:
    return f"reward_{term}"


TRIP = np.dtype(
    [
        ("run", np.int64),
        ("episode", np.int64),
        ("agent", np.int64),  # index of the agent
        ("map", np.int64),  # number of the map among the environment's maps
        ("began_s", np.float64),  # time of the episode at its first decision
        ("counted", np.bool_),  # whether it began in the first half of its episode
        ("arrived", np.bool_),  # how it ended: exactly one of these four
        ("collision", np.bool_),
        ("off_road", np.bool_),
        ("unfinished", np.bool_),  # cut by the horizon of the episode or of the trip
        ("blocked", np.bool_),  # unfinished: stopped where the built-in driver would stop, too
        ("stood", np.bool_),  # unfinished: stopped where the built-in driver would drive on
        ("out_of_time", np.bool_),  # unfinished: was moving
        # arrived in time, never entered a junction at red, never drove the wrong way. In time:
        # within the trip's horizon, or if it has none, SLOWEST times the free travel time
        ("success", np.bool_),
        ("red_light", np.bool_),  # whether it ever entered a junction at red
        ("wrong_way", np.bool_),  # whether it ever drove against its lane
        ("reward", np.float64),  # sum over the trip
        ("duration_s", np.float64),  # from its first decision to its end
        ("distance_m", np.float64),  # progress towards the goal
        ("mean_speed_mps", np.float64),  # distance over duration
        ("delay_s", np.float64),  # time lost compared with driving at `free_speed`
        ("mean_jerk_mps3", np.float64),  # mean |jerk|
        ("energy_wh", np.float64),  # energy of an electric car, minus recuperation
        ("co2_g", np.float64),  # CO₂ of a combustion engine
        ("mean_speeding", np.float64),  # mean speed above the limit, as a share of it
        ("least_ttc_s", np.float64),  # least time to collision, at most TTC_HORIZON_S
        ("short_ttc_share", np.float64),  # share of the trip with less than SHORT_TTC_S
        ("least_pet_s", np.float64),  # least post-encroachment time; NaN: none up to PET_HORIZON_S
        ("end_x_m", np.float64),  # position before the last step
        ("end_y_m", np.float64),
    ]
)

EPISODE = np.dtype(
    [
        ("run", np.int64),
        ("episode", np.int64),
        ("duration_s", np.float64),
        ("trips", np.int64),  # number of trips that ended or were cut in the episode
        ("episode_return", np.float64),  # sum of rewards of an agent id, mean over the ids
        ("agent_arrivals_per_h", np.float64),  # arrivals per hour of simulated time
        ("background_arrivals_per_h", np.float64),
        ("background_energy_wh_per_km", np.float64),  # as in TRIP; NaN: no background vehicle
        ("background_co2_g_per_km", np.float64),
        ("jain_speed", np.float64),  # Jain's index of the mean speeds of counted trips
        ("gini_delay", np.float64),  # Gini's coefficient of their delays per kilometre
        ("zone_imbalance", np.float64),  # max / mean of vehicles by zone; NaN: undivided
        ("v2x_reception_ratio", np.float64),  # packets received over packets in range; NaN: no V2X
        ("v2x_latency_s", np.float64),  # mean, from sending to receiving
        ("v2x_busy_ratio", np.float64),  # share of time in which the channel is busy
        *((reward_column(term), np.float64) for term in TERMS),  # the term's part of the return
    ]
)

TRACK = np.dtype(
    [("agent", np.int64), ("time_s", np.float64), ("x_m", np.float64), ("y_m", np.float64)]
)


TRANSFER = np.dtype(
    [
        ("run", np.int64),
        ("episode", np.int64),
        ("tick", np.int64),  # counted over all episodes of the world
        ("vehicle", np.int64),
        ("source", np.int64),
        ("target", np.int64),
        ("epoch", np.int64),
        ("forced", np.bool_),  # the state was sent with the change, as the target was not ready
        ("removed", np.bool_),  # the vehicle left the world in that tick
        ("approached", np.int64),  # tick of the first state at the target; -1: none
        ("waited", np.int64),  # ticks with the old owner after the crossing
        ("offers", np.int64),  # number of states that arrived at the target
        ("state_bytes", np.int64),
        ("prepare_depth_m", np.float64),  # distance outside of the source's zone at the first state
        ("switch_depth_m", np.float64),  # the same at the switch
        ("release_depth_m", np.float64),  # the same when the switch was committed
        ("ms", np.float64),  # from the first state to the target's confirmation; not repeatable
    ]
)

RESOURCE = np.dtype(
    [
        ("run", np.int64),
        ("process", np.int64),  # number of the worker or node; -1: the caller
        ("begin_s", np.float64),  # simulated time of the run at the beginning of the window
        ("ticks", np.int64),  # length of the window
        ("wall_s", np.float64),  # wall time of the window
        ("cpu_s", np.float64),  # processor time in the window
        ("memory_bytes", np.float64),  # resident at the end of the window
        ("waited_s", np.float64),  # time a node waited for frames; NaN, here and below: unknown
        ("sent_bytes", np.float64),  # to other nodes and to the caller
        ("sent_frames", np.float64),
        ("vehicles", np.float64),  # owned at the end of the window, in all worlds
        ("ghosts", np.float64),  # copies of vehicles of other zones
        ("slowest", np.float64),  # 1: the other nodes waited for this node
        ("migrations", np.float64),  # changes of owner in the window, in the row of the caller
    ]
)


def write_table(path: Path, tables: dict[str, Rows], dtype: np.dtype[np.void]) -> None:
    """Write the records of several policies into one CSV file; the first column is the policy."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["policy", *_names(dtype)])
        for policy, rows in tables.items():
            columns = [_texts(rows[name]) for name in _names(dtype)]
            writer.writerows([policy, *row] for row in zip(*columns, strict=True))


def read_table(path: Path, dtype: np.dtype[np.void]) -> dict[str, Rows]:
    """Return the records of a CSV file by policy, in the order of their first rows.

    A file of an older version may lack a column of numbers; its values are then NaN. A line that
    is too short or too long raises ValueError.
    """
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.reader(file)
        names = next(reader)
        by_policy: dict[str, list[dict[str, str]]] = {}
        for texts in reader:
            line = dict(zip(names, texts, strict=True))
            by_policy.setdefault(line["policy"], []).append(line)
    return {policy: _records(lines, dtype) for policy, lines in by_policy.items()}


def _names(dtype: np.dtype[np.void]) -> tuple[str, ...]:
    return dtype.names or ()


def _texts(column: NDArray[np.generic]) -> list[str]:
    """Return the shortest texts that restore the same numbers; NaN is an empty cell."""
    if column.dtype == np.bool_:
        return ["1" if value else "0" for value in column.tolist()]
    return ["" if value != value else repr(value) for value in column.tolist()]


def _records(lines: Sequence[Mapping[str, str]], dtype: np.dtype[np.void]) -> Rows:
    rows = np.zeros(len(lines), dtype=dtype)
    for name in _names(dtype):
        if dtype[name] == np.float64:
            rows[name] = [float(line.get(name) or np.nan) for line in lines]
        else:
            rows[name] = [int(line[name]) for line in lines]
    return rows


def map_outline(network: RoadNetwork) -> dict[str, Any]:
    """Return centre lines of car lanes in m, rounded to 0.1 m, and their mean width."""
    lanes = network.lanes
    open_lanes = np.flatnonzero(lanes["permissions"] & CARS != 0)
    lines = [_simplified(network.lane_polyline(int(lane))[:, :2]) for lane in open_lanes]
    return {
        "name": network.name,
        "extent_m": list(network.extent_m),
        "lane_width_m": float(lanes["width_m"][open_lanes].mean()),
        "lines": [np.round(line, 1).tolist() for line in lines],
    }


def _simplified(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a polyline (n, 2) without unnecessary points (Douglas and Peucker 1973)."""
    keep = np.zeros(len(line), dtype=np.bool_)
    keep[[0, -1]] = True
    stretches = [(0, len(line) - 1)]
    while stretches:
        first, last = stretches.pop()
        if last - first < 2:
            continue
        chord = line[last] - line[first]
        inner = line[first + 1 : last] - line[first]
        length = hypot(float(chord[0]), float(chord[1]))
        off = (
            np.abs(inner[:, 0] * chord[1] - inner[:, 1] * chord[0]) / length
            if length > 0.0
            else hypot_all(*inner.T)
        )
        worst = int(off.argmax())
        if off[worst] > TOLERANCE_M:
            middle = first + 1 + worst
            keep[middle] = True
            stretches += [(first, middle), (middle, last)]
    return line[keep]
