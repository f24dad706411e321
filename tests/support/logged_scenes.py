"""A small logged scene in both file formats: a crossing of four roads with some road users."""

from __future__ import annotations

import json
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]

STEP_S = 0.1
TIMES = 91
ARM_M, INNER_M, ASIDE_M = 100.0, 12.0, 1.75
ARMS = {"E": (1.0, 0.0), "N": (0.0, 1.0), "W": (-1.0, 0.0), "S": (0.0, -1.0)}
SIZES = {"VEHICLE": (4.5, 2.0, 1.6), "PEDESTRIAN": (0.5, 0.5, 1.7), "CYCLIST": (1.8, 0.7, 1.7)}


def lane_lines() -> dict[str, Numbers]:
    """Return lanes (n, 3): `inE` leads to the crossing, `outE` away from it, `tEW` over it."""
    lines = {}
    for name, (east, north) in ARMS.items():
        aside = ASIDE_M * np.array(
            [-north, east]
        )  # offset to the right of a vehicle that drives to the crossing
        far, near = (metres * np.array([east, north]) for metres in (ARM_M, INNER_M))
        lines[f"in{name}"] = _line(far + aside, near + aside)
        lines[f"out{name}"] = _line(near - aside, far - aside)
    for one in ARMS:
        for other in ARMS:
            if one != other:
                start, end = lines[f"in{one}"][-1, :2], lines[f"out{other}"][0, :2]
                forward = -np.array(ARMS[one])
                middle = start + forward * float(forward @ (end - start))
                share = np.linspace(0.0, 1.0, 13)[:, None]
                bend = (1 - share) ** 2 * start + 2 * share * (1 - share) * middle + share**2 * end
                lines[f"t{one}{other}"] = np.concatenate([bend, np.zeros((13, 1))], axis=1)
    return lines


def _line(start: Numbers, end: Numbers) -> Numbers:
    share = np.linspace(0.0, 1.0, 20)[:, None]
    return np.concatenate([start + share * (end - start), np.zeros((20, 1))], axis=1)


def edge_lines() -> list[Numbers]:
    """Return the road edges (n, 2); each one is the corner of the crossing between two arms."""
    half = 2.0 * ASIDE_M
    corner = np.array([(ARM_M, half), (half, half), (half, ARM_M)])
    turned = []
    for _ in range(4):
        turned.append(corner)
        corner = np.stack([-corner[:, 1], corner[:, 0]], axis=1)
    return turned


def track(
    x: float,
    y: float,
    east_mps: float,
    north_mps: float,
    kind: str = "VEHICLE",
    seen: tuple[int, int] = (0, TIMES),
) -> dict[str, Any]:
    """Return a track of ScenarioNet at constant velocity."""
    times = np.arange(TIMES) * STEP_S
    position = np.stack([x + east_mps * times, y + north_mps * times, 0.0 * times], axis=1)
    valid = np.zeros(TIMES, dtype=bool)
    valid[slice(*seen)] = True
    heading = math.atan2(north_mps, east_mps)
    state = {
        "position": np.where(valid[:, None], position, 0.0).astype(np.float32),
        "heading": np.where(valid, heading, 0.0).astype(np.float32),
        "velocity": np.tile([east_mps, north_mps], (TIMES, 1)).astype(np.float32),
        "valid": valid,
    }
    for name, size in zip(("length", "width", "height"), SIZES[kind], strict=True):
        state[name] = np.full(TIMES, size, dtype=np.float32)
    return {"type": kind, "state": state, "metadata": {"type": kind}}


def scenario() -> dict[str, Any]:
    """Return a scene of ScenarioNet that vehicle `7` has logged."""
    features: dict[str, Any] = {}
    for name, line in lane_lines().items():
        exits = [f"out{name[2]}"] if name.startswith("t") else []
        if name.startswith("in"):
            exits = [f"t{name[2]}{other}" for other in ARMS if other != name[2]]
        features[name] = {
            "type": "LANE_SURFACE_STREET",
            "polyline": line.astype(np.float32),
            "speed_limit_kmh": 50.0,
            "exit_lanes": exits,
        }
    for number, line in enumerate(edge_lines()):
        features[f"edge{number}"] = {"type": "ROAD_EDGE_BOUNDARY", "polyline": line}
    features["line"] = {"type": "ROAD_LINE_BROKEN_SINGLE_WHITE", "polyline": edge_lines()[0]}
    tracks = {
        "7": track(-60.0, -ASIDE_M, 10.0, 0.0),
        "8": track(80.0, ASIDE_M, -8.0, 0.0),
        "9": track(ASIDE_M, -95.0, 0.0, 9.0, seen=(20, TIMES)),
        "walker": track(40.0, 9.0, 0.0, 1.2, "PEDESTRIAN"),
        "rider": track(-ASIDE_M, 95.0, 0.0, -5.0, "CYCLIST", seen=(0, 60)),
        "parked": track(30.0, 30.0, 0.0, 0.0),
    }
    return {
        "id": "made",
        "version": "1",
        "length": TIMES,
        "metadata": {
            "ts": (np.arange(TIMES) * STEP_S).astype(np.float32),
            "sdc_id": "7",
            "current_time_index": 10,
        },
        "tracks": tracks,
        "dynamic_map_states": {},
        "map_features": features,
    }


def gpudrive(in_degrees: bool = False) -> dict[str, Any]:
    """Return the same scene as a document of GPUDrive, which has no lane exits and speed limits."""
    scene = scenario()
    objects = []
    for number, entry in enumerate(scene["tracks"].values()):
        state = entry["state"]
        factor = 180.0 / math.pi if in_degrees else 1.0
        objects.append(
            {
                "id": number,
                "type": entry["type"].lower(),
                "position": _points(state["position"]),
                "heading": [factor * float(one) for one in state["heading"]],
                "velocity": [{"x": float(x), "y": float(y)} for x, y in state["velocity"]],
                "valid": state["valid"].tolist(),
                "goalPosition": {"x": 0.0, "y": 0.0},
                **dict(zip(("length", "width", "height"), SIZES[entry["type"]], strict=True)),
            }
        )
    kinds = {"LANE": "lane", "ROAD_EDGE": "road_edge", "ROAD_LINE": "road_line"}
    roads = [
        {
            "id": number,
            "type": next(kind for key, kind in kinds.items() if feature["type"].startswith(key)),
            "map_element_id": 2,
            "geometry": _points(feature["polyline"]),
        }
        for number, feature in enumerate(scene["map_features"].values())
    ]
    return {
        "name": "made.json",
        "scenario_id": "made",
        "objects": objects,
        "roads": roads,
        "tl_states": {},
        "metadata": {"sdc_track_index": 0},
    }


def _points(points: Numbers) -> list[dict[str, float]]:
    return [{"x": float(point[0]), "y": float(point[1]), "z": 0.0} for point in points]


def write_pickle(folder: Path, scene: object | None = None) -> Path:
    """Write a scene of ScenarioNet."""
    path = folder / "made.pkl"
    path.write_bytes(pickle.dumps(scenario() if scene is None else scene))
    return path


def write_json_scene(folder: Path, scene: object | None = None) -> Path:
    """Write a scene of GPUDrive."""
    path = folder / "made.json"
    path.write_text(json.dumps(gpudrive() if scene is None else scene), encoding="utf-8")
    return path
