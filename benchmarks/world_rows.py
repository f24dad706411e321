"""Rows, each with the comparison of a random world with SUMO, and summaries of rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from benchmarks.map_features import MAP_FEATURES
from benchmarks.world_draw import WorldDraw
from cavmarl.evaluate.traffic.traffic_comparison import TrafficComparison

Row = dict[str, Any]  # a line of worlds.jsonl

# Tolerances as shares of SUMO's mean; the delay also has a tolerance in seconds.
SPEED_SHARE, COUNT_SHARE, DELAY_SHARE, DELAY_S = 0.15, 0.05, 0.25, 3.0
LOCK_S = 120.0
_SPREAD_OF = ("departed", "arrived", "mean_speed_mps", "mean_delay_s", "queue", "longest_lock_s")


def row_of(draw: WorldDraw, found: TrafficComparison, of_map: Sequence[str] = ()) -> Row:
    """Return the row of a comparison, with the figures of cavmarl and of each of SUMO's seeds.

    `of_map`: the `map_features` of the net.
    """
    sumo = [asdict(figures) for figures in (found.sumo.figures, *found.sumo_others)]
    return {
        "seed": draw.seed,
        "features": [*draw.features, *of_map],
        "seconds": found.seconds,
        "dt_s": found.dt_s,
        "ours": asdict(found.ours.figures),
        "sumo": sumo[0],
        "sumo_spread": {name: [run[name] for run in sumo] for name in _SPREAD_OF},
    }


def failed_row(draw: WorldDraw, seconds: int, dt_s: float, error: Exception) -> Row:
    """Return the row of a world that could not be compared."""
    own = {"seed": draw.seed, "features": list(draw.features), "seconds": seconds, "dt_s": dt_s}
    return own | {"error": f"{type(error).__name__}: {error}"}


def deviation(row: Mapping[str, Any], figure: str) -> float | None:
    """Return the relative deviation from the mean of SUMO's seeds; None if SUMO has no value."""
    ours, theirs = row["ours"][figure], _known(row["sumo_spread"][figure])
    mean = sum(theirs) / len(theirs) if theirs else 0.0
    return ours / mean - 1.0 if ours is not None and mean else None


def in_spread(row: Mapping[str, Any], figure: str) -> bool:
    """Return whether the figure lies within the range of SUMO's seeds."""
    ours, theirs = row["ours"][figure], _known(row["sumo_spread"][figure])
    return ours is not None and bool(theirs) and min(theirs) <= ours <= max(theirs)


def is_near(row: Mapping[str, Any], figure: str, share: float) -> bool:
    """Return whether the figure is within a share of SUMO's mean, or within SUMO's range."""
    off = deviation(row, figure)
    return in_spread(row, figure) or (off is not None and abs(off) <= share)


def is_delay_near(row: Mapping[str, Any]) -> bool:
    """Return whether the mean delay is within `DELAY_SHARE` or `DELAY_S` of SUMO's mean."""
    ours, theirs = row["ours"]["mean_delay_s"], _known(row["sumo_spread"]["mean_delay_s"])
    if ours is None or not theirs:
        return ours is None and not theirs
    off_s = abs(ours - sum(theirs) / len(theirs))
    return off_s <= DELAY_S or is_near(row, "mean_delay_s", DELAY_SHARE)


def has_own_lock(row: Mapping[str, Any]) -> bool:
    """Return whether a lock of over `LOCK_S` occurs here, but with none of SUMO's seeds."""
    theirs = max(row["sumo_spread"]["longest_lock_s"])
    return bool(row["ours"]["longest_lock_s"] > LOCK_S >= theirs)


def sumo_beside_itself(row: Mapping[str, Any]) -> list[Row]:
    """Return a row for each of SUMO's seeds in comparison with SUMO's other seeds."""
    spread = row["sumo_spread"]
    return [
        {
            "ours": {figure: values[k] for figure, values in spread.items()},
            "sumo_spread": {name: values[:k] + values[k + 1 :] for name, values in spread.items()},
        }
        for k in range(len(spread["arrived"]))
    ]


def badness(row: Mapping[str, Any]) -> float:
    """Return the sort key of bad worlds: failed, contacts, locks, then speed and departures."""
    if "error" in row:
        return 1e6
    off = deviation(row, "mean_speed_mps")
    missing = deviation(row, "departed")
    faults = 100.0 * row["ours"]["contacts"] + 10.0 * has_own_lock(row)
    return float(faults + abs(off or 0.0) + abs(missing or 0.0))


def worst(rows: Sequence[Row], count: int) -> list[Row]:
    """Return the rows farthest from SUMO, worst first; ties by the smaller seed."""
    return sorted(rows, key=lambda row: (-badness(row), row["seed"]))[:count]


def summary(rows: Sequence[Row]) -> Row:
    """Return the distribution of figures over the worlds that could be compared."""
    good = [row for row in rows if "error" not in row]
    found: Row = {"worlds": len(rows), "failed": len(rows) - len(good)}
    if not good:
        return found
    peers = [peer for row in good for peer in sumo_beside_itself(row)]
    speeds = [off for row in good if (off := deviation(row, "mean_speed_mps")) is not None]
    found["mean_speed"] = {
        **_sizes(speeds),
        "share_near": _share(is_near(row, "mean_speed_mps", SPEED_SHARE) for row in good),
        "share_in_spread": _share(in_spread(row, "mean_speed_mps") for row in good),
        "sumo_near": _share(is_near(peer, "mean_speed_mps", SPEED_SHARE) for peer in peers),
    }
    for figure in ("arrived", "departed"):
        offs = [off for row in good if (off := deviation(row, figure)) is not None]
        near, sumo_near = (
            _share(is_near(row, figure, COUNT_SHARE) for row in of) for of in (good, peers)
        )
        found[figure] = _sizes(offs) | {"share_near": near, "sumo_near": sumo_near}
    found["mean_delay"] = {
        "share_near": _share(map(is_delay_near, good)),
        "sumo_near": _share(map(is_delay_near, peers)),
    }
    found["queue"] = {
        side: float(np.mean([row[side]["queue"] for row in good])) for side in ("ours", "sumo")
    }
    found["contacts"] = {
        side: int(sum(row[side]["contacts"] for row in good)) for side in ("ours", "sumo")
    }
    found["contacts"]["worlds"] = sum(row["ours"]["contacts"] > 0 for row in good)
    found["own_locks"] = sum(map(has_own_lock, good))
    return found


def by_feature(rows: Sequence[Row]) -> dict[str, Row]:
    """Return for each feature the summary of the worlds that have it."""
    names = sorted({name for row in rows for name in row["features"]})
    return {name: summary([row for row in rows if name in row["features"]]) for name in names}


def comparable(rows: Sequence[Row]) -> list[Row]:
    """Return the worlds that should match SUMO: worlds without any of `MAP_FEATURES`."""
    return [row for row in rows if MAP_FEATURES.isdisjoint(row["features"])]


def _known(values: Sequence[float | None]) -> list[float]:
    return [value for value in values if value is not None]


def _sizes(offs: Sequence[float]) -> Row:
    """Return the median of signed and of absolute deviations, and their 90 % quantile."""
    if not offs:
        return {"median": None, "median_size": None, "size_90": None}
    sizes = np.abs(offs)
    return {
        "median": float(np.median(offs)),
        "median_size": float(np.median(sizes)),
        "size_90": float(np.quantile(sizes, 0.9)),
    }


def _share(held: Any) -> float:
    return float(np.mean(list(held)))
