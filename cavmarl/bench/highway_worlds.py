"""Equal worlds for both sides of a comparison: cavmarl's and highway-env's.

N controlled vehicles are on a straight road of four lanes at highway-env's initial density; there
is no other traffic. All vehicles use the meta-action IDLE, at 20 Hz with 10 decisions per second.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cavmarl.core.errors import require

RAYS = 64
RANGE_M = 60.0
NEIGHBORS = 16
SIM_HZ = 20
CONTROL_HZ = 10
LANES = 4
LANE_WIDTH_M = 3.2
SPEED_MPS = 30.0
RUN_OUT_M = 1500.0
IDLE = 1  # number of the meta-action in highway-env

# Sensors of cavmarl in addition to ego and signal. In highway-env, the lidar observation has no
# neighbours, no observation has a route, and `Kinematics` has four neighbours by default.
LIDAR: dict[str, Any] = {
    "sensors.route.points": 0,
    "sensors.neighbors.count": NEIGHBORS,
    "sensors.lidar.rays": RAYS,
    "sensors.lidar.range_m": RANGE_M,
    "sensors.lidar.speeds": True,
}
KINEMATICS: dict[str, Any] = {"sensors.neighbors.count": NEIGHBORS, "sensors.lidar.rays": 0}

THEIR_LIDAR = {"type": "LidarObservation", "cells": RAYS, "maximum_range": RANGE_M}
THEIR_KINEMATICS = {"type": "Kinematics"}
THEIR_RAW_KINEMATICS = {"type": "Kinematics", "normalize": False}


def overrides(sensors: dict[str, Any], agents: int) -> dict[str, Any]:
    """Return the overrides for a cavmarl world on `straight_road`."""
    return {
        "clock.sim_dt_s": 1.0 / SIM_HZ,
        "clock.ctrl_dt_s": 1.0 / CONTROL_HZ,
        "action.kind": "discrete",
        "population.budget": agents,
        "traffic.origins": ["road"],
        "traffic.destinations": ["end"],
        **sensors,
    }


def highway_env(agents: int, observation: dict[str, Any]) -> Any:
    """Create highway-env's own highway with `agents` controlled vehicles, stepped once."""
    gymnasium = require("gymnasium", "bench")
    config = {
        "controlled_vehicles": agents,
        "vehicles_count": 0,
        "lanes_count": LANES,
        "duration": 1e9,
        "simulation_frequency": SIM_HZ,
        "policy_frequency": CONTROL_HZ,
        "offscreen_rendering": True,
        "action": {"type": "MultiAgentAction", "action_config": {"type": "DiscreteMetaAction"}},
        "observation": {"type": "MultiAgentObservation", "observation_config": observation},
    }
    env = gymnasium.make("highway-v0", config=config).unwrapped
    env.reset(seed=0)
    env.step((IDLE,) * agents)
    return env


def length_m(env: Any) -> float:
    """Return the length of highway-env's occupied road, plus one gap per lane."""
    along = [vehicle.position[0] for vehicle in env.controlled_vehicles]
    return float(max(along) - min(along)) + LANES * 10.0


def straight_road(folder: Path, road_m: float) -> Path:
    """Write a SUMO net: a straight `road`, and an `end` that no vehicle reaches."""
    whole_m = road_m + RUN_OUT_M

    # Centres of the lanes; lane 0 is the rightmost lane, and the road goes east.
    ys = [f"{(k - LANES) * LANE_WIDTH_M:.2f}" for k in range(LANES)]

    def lanes(edge: str, begin_m: float, end_m: float) -> str:
        return "".join(
            f'<lane id="{edge}_{k}" index="{k}" speed="{SPEED_MPS}" length="{end_m - begin_m:.2f}" '
            f'shape="{begin_m:.2f},{y} {end_m:.2f},{y}"/>'
            for k, y in enumerate(ys)
        )

    incoming = {edge: " ".join(f"{edge}_{k}" for k in range(LANES)) for edge in ("road", "end")}
    joins = "".join(
        f'<connection from="road" to="end" fromLane="{k}" toLane="{k}" dir="s" state="M"/>'
        for k in range(LANES)
    )
    nowhere = 'incLanes="" intLanes="" shape=""'
    path = folder / f"straight_{road_m:.0f}.net.xml"
    path.write_text(
        f"""<net version="1.20">
        <edge id="road" from="west" to="middle">{lanes("road", 0.0, road_m)}</edge>
        <edge id="end" from="middle" to="east">{lanes("end", road_m, whole_m)}</edge>
        <junction id="west" type="dead_end" x="0" y="0" {nowhere}/>
        <junction id="middle" type="priority" x="{road_m:.2f}" y="0"
            incLanes="{incoming["road"]}" intLanes="" shape=""/>
        <junction id="east" type="dead_end" x="{whole_m:.2f}" y="0"
            incLanes="{incoming["end"]}" intLanes="" shape=""/>
        {joins}
        </net>
        """,
        encoding="utf-8",
    )
    return path
