"""Results by map, for environments with several maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.evaluate.metrics import KM_PER_INFRACTION, METRICS, metric_values

# Metrics of a row, besides the map's name and number of trips.
SHOWN = ("success", "collision", "off_road", "red_light", "stood", "blocked", KM_PER_INFRACTION)


def rows_by_map(
    tables: Mapping[str, tuple[NDArray[np.void], NDArray[np.void]]], names: Sequence[str]
) -> dict[str, list[dict[str, Any]]]:
    """Return for each policy one row per map, worst success first; {} for one map.

    `tables`: TRIP and EPISODE records. `names`: names of the maps. Maps without counted trips are
    left out.
    """
    if len(names) < 2:
        return {}
    return {policy: _rows(trips, episodes, names) for policy, (trips, episodes) in tables.items()}


def _rows(
    trips: NDArray[np.void], episodes: NDArray[np.void], names: Sequence[str]
) -> list[dict[str, Any]]:
    metrics = [metric for metric in METRICS if metric.name in SHOWN]
    rows: list[dict[str, Any]] = []
    for number, name in enumerate(names):
        own = trips[trips["map"] == number]
        if count := int(own["counted"].sum()):
            means = {m.name: float(metric_values(m, own, episodes).mean()) for m in metrics}
            rows.append({"map": name, "trips": count, **means})
    return sorted(rows, key=lambda row: (row["success"], row["map"]))
