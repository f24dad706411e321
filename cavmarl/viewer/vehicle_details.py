"""What a page is told of the world, and of the vehicle that it watches."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    DRIVER_SCRIPTED,
    DRIVER_SUMO,
)
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.env.parallel import CavEnv, Observation
from cavmarl.roads.network import VEHICLE_CLASSES
from cavmarl.sensors.observed import layout, sensors_of

DRIVERS = {
    DRIVER_BACKGROUND: "traffic",
    DRIVER_AGENT: "agent",
    DRIVER_SCRIPTED: "script",
    DRIVER_SUMO: "SUMO",
}
MOST_NUMBERS = 400  # of an observation that are shown


def hello_of(env: CavEnv, origin: NDArray[np.float64], policy: str) -> dict[str, Any]:
    """What a page is told first: JSON about the world, places in metres from `origin`."""
    config = env.config
    min_x, min_y, max_x, max_y = env.network.extent_m
    zones: list[list[float]] = []
    partition = env.worlds.world.partition
    if partition.count > 1:
        low = np.array([min_x - 50.0, min_y - 50.0] * 2)
        high = np.array([max_x + 50.0, max_y + 50.0] * 2)
        zones = (np.clip(partition.reaching, low, high) - np.tile(origin, 2)).tolist()
    return {
        "kind": "hello",
        "title": f"{config.name}",
        "policy": policy,
        "step_s": env.step_s,
        "agents": list(env.possible_agents),
        "action": config.action.kind,
        "zones": zones,
        "drivers": DRIVERS,
        "classes": [*VEHICLE_CLASSES, "pedestrian"],
    }


def vehicle_details(
    env: CavEnv,
    frame: WorldFrame,
    vehicle: int,
    observations: Mapping[str, Observation],
    infos: Mapping[str, Mapping[str, float]],
) -> dict[str, Any]:
    """The state of a vehicle; of an agent's also what it observes and is paid.

    Its `rows` are pairs of a name and what the page shows beside it.
    """
    place = int(np.searchsorted(frame.vehicles["id"], vehicle))
    if place == len(frame.vehicles) or frame.vehicles["id"][place] != vehicle:
        return {"kind": "vehicle", "id": vehicle, "here": False, "rows": []}
    row = frame.vehicles[place]
    lane = int(row["lane"])
    agent = env.possible_agents[row["agent"]] if row["agent"] >= 0 else None
    rows = [
        ["speed", f"{row['speed']:.2f} m/s ({3.6 * row['speed']:.0f} km/h)"],
        ["acceleration", f"{row['accel']:.2f} m/s²"],
        ["steering", f"{math.degrees(row['steering']):.1f}°"],
        ["lane", env.network.lane_ids[lane] if lane >= 0 else "none"],
        ["driver", DRIVERS.get(int(row["driver"]), str(row["driver"]))],
        ["agent", agent or "none"],
        ["zone", str(row["zone"])],
        ["driven", f"{row['distance_m']:.0f} m"],
        ["size", f"{row['length']:.1f} x {row['width']:.1f} m"],
        ["place", f"{row['x']:.1f}, {row['y']:.1f}, {row['z']:.1f} m"],
    ]
    if math.isfinite(row["to_go"]) and agent is not None:
        rows.insert(8, ["to go", f"{row['to_go']:.0f} m"])
    if row["transfer"]:
        rows.insert(7, ["handed over to zone", str(row["target_zone"])])
    found: dict[str, Any] = {"kind": "vehicle", "id": vehicle, "here": True, "rows": rows}
    if agent is not None and agent in infos:
        told = infos[agent]
        names = env.config.terms.names
        found["terms"] = [[name, round(float(told.get(name, 0.0)), 4)] for name in names]
    if agent is not None and agent in observations:
        found["observation"] = _observed(env, observations[agent])
    return found


def _observed(env: CavEnv, observation: Observation) -> list[list[Any]]:
    """Sensor, feature and number of each of the features; of a stack the newest frame."""
    config = env.config
    if config.observation.mode == "sensors" or isinstance(observation, Mapping):
        named = observation if isinstance(observation, Mapping) else {"rig": observation}
        return [
            [name, str(k), _number(value)]
            for name, numbers in named.items()
            for k, value in enumerate(np.asarray(numbers).ravel()[: MOST_NUMBERS // len(named)])
        ]
    size = len(observation) // config.sensors.stack
    newest = np.asarray(observation)[-size:]
    places = layout(config.sensors)
    rows = []
    for sensor in sensors_of(config.sensors):
        if sensor.name in places:
            values = newest[places[sensor.name]]
            features = sensor.features(config.sensors)
            rows += [
                [sensor.name, feature.name, _number(value)]
                for feature, value in zip(features, values, strict=True)
            ]
    return rows[:MOST_NUMBERS]


def _number(value: Any) -> float | None:
    number = float(value)
    return round(number, 4) if math.isfinite(number) else None
