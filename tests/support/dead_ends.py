"""A road of two lanes: the left lane leads to the goal, the right lane to a dead end."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from cavmarl.engine.simulation import Simulation
from tests.support.driving import make_simulation, start
from tests.support.netgenerate import netconvert

DEAD_END = {
    "nod": """<nodes><node id="a" x="0" y="0"/><node id="b" x="300" y="0" type="unregulated"/>
        <node id="c" x="600" y="0"/><node id="d" x="300" y="-{length_m:g}"/></nodes>""",
    "edg": """<edges><edge id="ab" from="a" to="b" numLanes="2"/><edge id="bc" from="b" to="c"/>
        <edge id="bd" from="b" to="d"/><edge id="db" from="d" to="b"/></edges>""",
    "con": """<connections><connection from="ab" to="bc" fromLane="1" toLane="0"/>
        <connection from="ab" to="bd" fromLane="0" toLane="0"/>
        <connection from="db" to="bc" fromLane="0" toLane="0"/></connections>""",
}


def before_dead_end(folder: Path, length_m: float) -> tuple[Simulation, int, int, int]:
    """Return a world with two agents, the right and the left lane, and the goal edge.

    Args:
        folder: folder for the map.
        length_m: length of the dead end. If it is short, the route from the right lane leads
            through the dead end, otherwise over a lane change.
    """
    for kind, text in DEAD_END.items():
        (folder / f"m.{kind}.xml").write_text(text.format(length_m=length_m))
    overrides = {"traffic.destinations": ["bc"], "traffic.min_trip_m": 0.0}
    path = netconvert(folder, "m")
    world = make_simulation(path, mode="respawn", agents=2, background=0, overrides=overrides)
    start(world, 0)
    right, left = (world.network.lane_ids.index(f"ab_{k}") for k in (0, 1))
    return world, right, left, int(world.vehicles(0)["goal"][0])


def put(world: Simulation, row: np.void, lane: int, s: float, speed: float, goal: int) -> None:
    """Put a vehicle on a lane with a goal."""
    x, y, _, cos, sin = world.network.pose_on(lane, s)[:5]
    row["lane"], row["s"], row["d"], row["x"], row["y"] = lane, s, 0.0, x, y
    row["heading"], row["speed"] = math.atan2(sin, cos), speed
    row["side_lane"], row["target_lane"] = -1, lane
    row["goal"], row["way"] = goal, goal * len(world.network.lanes)
