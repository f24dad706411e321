"""The data that a page gets about a world, and about the vehicle that it watches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from cavmarl.config.env import EnvConfig
from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    DRIVER_EXTERNAL,
    DRIVER_LEARNED,
    DRIVER_SCRIPTED,
    DRIVER_SUMO,
)
from cavmarl.engine.spaces import sensed_observation
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.env.parallel import CavEnv
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.worlds.step_arrays import StepArrays
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork
from cavmarl.sensors.observed import feature_names
from cavmarl.sensors.sensed_shapes import Shape, observed_shapes, sampled_shapes
from cavmarl.viewer.map_geometry import map_origin
from cavmarl.zones.partition.zone_partition import ZonePartition

DRIVERS = {
    DRIVER_BACKGROUND: "traffic",
    DRIVER_AGENT: "agent",
    DRIVER_SCRIPTED: "script",
    DRIVER_SUMO: "SUMO",
    DRIVER_EXTERNAL: "external",
    DRIVER_LEARNED: "traffic (neural network)",
}
MOST_NUMBERS = 400  # largest number of observed values to show
ZONE_MARGIN_M = 50.0  # margin around the map up to which zones are drawn

ViewedEnv = CavEnv | CavVectorEnv


def hello_of_map(
    title: str, network: RoadNetwork, partition: ZonePartition, step_s: float
) -> dict[str, Any]:
    """Return what all first messages to pages contain; positions in m from the map's origin."""
    origin = map_origin(network)
    min_x, min_y, max_x, max_y = network.extent_m
    zones: list[list[float]] = []
    if partition.count > 1:
        low = np.array([min_x - ZONE_MARGIN_M, min_y - ZONE_MARGIN_M] * 2)
        high = np.array([max_x + ZONE_MARGIN_M, max_y + ZONE_MARGIN_M] * 2)
        zones = (np.clip(partition.reaching, low, high) - np.tile(origin, 2)).tolist()
    return {
        "kind": "hello",
        "title": title,
        "policy": "",
        "step_s": step_s,
        "agents": [],
        "action": "",
        "may": ["pause", "step", "pace"],
        "zones": zones,
        "drivers": DRIVERS,
        "classes": [*VEHICLE_CLASSES, "pedestrian"],
    }


def hello_of(env: ViewedEnv, policy: str, *, is_driven_here: bool = True) -> dict[str, Any]:
    """Return the first message to a page about an environment's world.

    Args:
        env: environment of the world.
        policy: description of the policy that drives the world.
        is_driven_here: whether pages may restart episodes and take seats.
    """
    config = env.config
    partition = env.worlds.world.partition
    own = {"policy": policy, "agents": list(env.possible_agents), "action": config.action.kind}
    hello = hello_of_map(f"{config.name}", env.network, partition, env.step_s) | own
    if is_driven_here:
        hello["may"] = [*hello["may"], "reset", "seat"]
    if config.population.insertions:
        hello["may"] = [*hello["may"], "insert"]
    if config.map.changed_lanes:
        hello["may"] = [*hello["may"], "close", "open"]
    return hello


def vehicle_state(
    network: RoadNetwork, agents: list[str], frame: WorldFrame, vehicle: int
) -> dict[str, Any]:
    """Return the state of a vehicle; its `rows` are pairs of a name and a value to show."""
    place = int(np.searchsorted(frame.vehicles["id"], vehicle))
    if place == len(frame.vehicles) or frame.vehicles["id"][place] != vehicle:
        return {"kind": "vehicle", "id": vehicle, "here": False, "rows": []}
    row = frame.vehicles[place]
    lane, number = int(row["lane"]), int(row["agent"])
    agent = None if number < 0 else agents[number] if number < len(agents) else f"car_{number}"
    rows = [
        ["speed", f"{row['speed']:.2f} m/s ({3.6 * row['speed']:.0f} km/h)"],
        ["acceleration", f"{row['accel']:.2f} m/s²"],
        ["steering", f"{math.degrees(row['steering']):.1f}°"],
        ["lane", network.lane_ids[lane] if 0 <= lane < len(network.lane_ids) else "none"],
        ["driver", DRIVERS.get(int(row["driver"]), str(row["driver"]))],
        ["agent", agent or "none"],
        ["zone", str(row["zone"])],
        ["driven", f"{row['distance_m']:.0f} m"],
        ["size", f"{row['length']:.1f} x {row['width']:.1f} m"],
        ["position", f"{row['x']:.1f}, {row['y']:.1f}, {row['z']:.1f} m"],
    ]
    if math.isfinite(row["to_go"]) and agent is not None:
        rows.insert(8, ["distance to goal", f"{row['to_go']:.0f} m"])
    if row["transfer"]:
        rows.insert(7, ["in transfer to zone", str(row["target_zone"])])
    return {"kind": "vehicle", "id": vehicle, "here": True, "agent": number, "rows": rows}


def vehicle_details(
    env: ViewedEnv, world: int, frame: WorldFrame, vehicle: int, sensors: bool = False
) -> dict[str, Any]:
    """Return the state and the path of a vehicle, and an agent's observation and reward.

    With `sensors`, add its sensor data; see `sensed_shapes`.
    """
    found = vehicle_state(env.network, env.possible_agents, frame, vehicle)
    if not found["here"]:
        return found
    way = env.way_ahead(vehicle, world) - map_origin(env.network)
    found["way"] = np.round(way, 1).ravel().tolist()
    agent = found["agent"]
    arrays = env.worlds.arrays
    if agent < 0 or arrays.vehicle_ids[world, agent] != vehicle:
        return found
    found["terms"] = named_terms(env.config.terms.names, arrays.terms[world, agent])
    found["observation"] = _observed(env, world, agent)
    if sensors:
        found["shapes"] = sensed_shapes(env.config, arrays, world, agent)
    return found


def sensed_shapes(config: EnvConfig, arrays: StepArrays, world: int, agent: int) -> list[Shape]:
    """Return the shapes of an agent's observation, then of the last samples of its rig."""
    shapes = observed_shapes(config, arrays.observations[world, agent])
    for name, settings in config.rig.items():
        frames = arrays.frames[name]
        if not frames.lost[world, agent, -1]:
            shapes += sampled_shapes(name, settings, np.asarray(frames.data[world, agent, -1]))
    return shapes


def _observed(env: ViewedEnv, world: int, agent: int) -> list[list[Any]]:
    """Return sensor, feature and value of each feature in the newest frame."""
    config, arrays = env.config, env.worlds.arrays
    if config.observation.mode == "sensors":
        sensed = sensed_observation(arrays.frames)
        return [
            [name, str(k), _number(value)]
            for name, numbers in sensed.items()
            for k, value in enumerate(numbers[world, agent].ravel()[: MOST_NUMBERS // len(sensed)])
        ]
    return named_numbers(feature_names(config.sensors), arrays.observations[world, agent])


def named_numbers(names: Sequence[Sequence[str]], numbers: Any) -> list[list[Any]]:
    """Return sensor, feature and value of each number of the newest frame, given their names."""
    newest = numbers[-len(names) :] if len(names) else []
    rows = [[*name, _number(value)] for name, value in zip(names, newest, strict=True)]
    return rows[:MOST_NUMBERS]


def named_terms(names: Sequence[str], terms: Any) -> list[list[Any]]:
    """Return name and value of each reward term."""
    return [[name, round(float(value), 4)] for name, value in zip(names, terms, strict=True)]


def _number(value: Any) -> float | None:
    number = float(value)
    return round(number, 4) if math.isfinite(number) else None
