"""Targets for logged scenes: pickles of ScenarioNet, JSON files of GPUDrive."""

from __future__ import annotations

import json
import pickle

import numpy as np

from cavmarl.maps.scenes.scene_files import read_scene
from cavmarl.maps.scenes.scene_roads import scene_network
from cavmarl.roads.sumo_net.reader import read_network
from fuzz.files import Target, scratch

__all__ = ["DOCUMENTS", "PICKLES"]

LANES = {
    "a": [(0.0, 0.0), (30.0, 0.0)],
    "b": [(30.0, 0.0), (40.0, 0.0)],
    "c": [(30.0, 0.0), (36.0, 2.0), (40.0, 6.0)],
    "d": [(40.0, 0.0), (80.0, 0.0)],
    "e": [(40.0, 6.0), (60.0, 26.0)],
}


def _read(name: str, content: bytes) -> None:
    network = scene_network(read_scene(scratch(name, content)))
    read_network(scratch("x.net.xml", network.text.encode()))


def _pickle(content: bytes) -> None:
    _read("x.pkl", content)


def _document(content: bytes) -> None:
    _read("x.json", content)


def _pickles() -> tuple[bytes, ...]:
    features: dict[str, object] = {
        name: {"type": "LANE_SURFACE_STREET", "polyline": np.array(line), "speed_limit_mph": 25}
        for name, line in LANES.items()
    }
    features["edge"] = {"type": "ROAD_EDGE_BOUNDARY", "polyline": np.zeros((2, 3), np.float32)}
    state = {
        "position": np.array([(1.0, 0.0, 0.0), (2.0, 0.0, 0.0)], np.float32),
        "heading": np.zeros(2, np.float32),
        "valid": np.ones(2, bool),
    }
    scene = {
        "id": "x",
        "length": 2,
        "metadata": {"ts": np.array([0.0, 0.1]), "sdc_id": "1"},
        "tracks": {"1": {"type": "VEHICLE", "state": state}},
        "map_features": features,
        "dynamic_map_states": {},
    }
    return tuple(pickle.dumps(scene, protocol) for protocol in (2, 4, 5))


def _documents() -> tuple[bytes, ...]:
    roads = [
        {"id": name, "type": "lane", "geometry": [{"x": x, "y": y} for x, y in line]}
        for name, line in LANES.items()
    ]
    vehicle = {
        "type": "vehicle",
        "position": [{"x": 1.0, "y": 0.0}, {"x": 2.0, "y": 0.0}],
        "heading": [0.0, 0.0],
        "valid": [True, True],
        "length": 4.5,
        "width": 1.9,
    }
    scene = {"name": "x", "objects": [vehicle], "roads": roads, "tl_states": {}}
    return (json.dumps(scene).encode(),)


PICKLES = Target(_pickle, _pickles)
DOCUMENTS = Target(_document, _documents)
