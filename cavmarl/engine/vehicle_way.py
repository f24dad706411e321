"""The remaining route of a vehicle as a line along lane centres, for pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.core.records.codes import DRIVER_SCRIPTED
from cavmarl.engine.world_views import WorldViews

MOST_LANES = 400


def way_ahead(simulation: WorldViews, vehicle: int, world: int = 0) -> NDArray[np.float64]:
    """Return points (n, 2) in m from a vehicle's position to the end of its route.

    There are no points if the vehicle is not in the world, follows a script or has no route.
    """
    rows = simulation.vehicles(world)
    rows = rows[rows["id"] == vehicle]
    if not len(rows) or rows[0]["lane"] < 0 or rows[0]["driver"] == DRIVER_SCRIPTED:
        return np.zeros((0, 2))
    network, steps = simulation.network, simulation.travel.steps
    lane, way, start_m = int(rows[0]["lane"]), int(rows[0]["way"]), float(rows[0]["s"])
    parts = [np.zeros((0, 2))]
    for _ in range(MOST_LANES):
        row = network.lanes[lane]
        if row["internal"]:
            parts.append(_from(network.lane_polyline(lane)[:, :2], start_m))
            following = int(row["successor"])
        else:
            at = way + lane
            if not 0 <= at < len(steps):
                break
            step = steps[at]
            if step["change"]:  # the route continues on the adjacent lane
                following = int(row["left"] if step["change"] > 0 else row["right"])
                if following < 0:
                    break
                lane = following
                continue
            parts.append(_from(network.lane_polyline(lane)[:, :2], start_m))
            following, way = int(step["next"]), way + int(step["shift"])
        if following < 0:
            break
        lane, start_m = following, 0.0
    return np.concatenate(parts)


def _from(line: NDArray[np.float64], start_m: float) -> NDArray[np.float64]:
    """Return the part of a line (n, 2) after `start_m`."""
    if start_m <= 0.0:
        return line
    along = np.concatenate([[0.0], np.cumsum(hypot_all(*np.diff(line, axis=0).T))])
    start_m = min(start_m, float(along[-1]))
    begin = [np.interp(start_m, along, line[:, k]) for k in range(2)]
    return np.concatenate([[begin], line[along > start_m]])
