"""Worlds that are cut through a roundabout, a bridge or a junction equal the undivided world."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.engine.world_setup import find_map
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.verify.equivalence import verify_zones
from tests.support.borders import bounds_around, cut_at

FAST = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.2, "population.mode": "respawn"}
BRIDGE_M = 4.0  # smallest height of a bridge above the road below
NEAR_M = 5.0  # largest horizontal distance between points of these two roads
Place = NDArray[np.float64]


def equal_around(place: Place, net: Path, folder: Path, *, crossings: int, steps: int = 60) -> None:
    """Compare worlds with four zones that meet at `place`, and with nine zones around `place`."""
    x, y = (float(v) for v in place[:2])
    bounds = bounds_around(load_network(net))
    for name, xs, ys in (("four", [x], [y]), ("nine", [x - 6.0, x + 6.0], [y - 6.0, y + 6.0])):
        layout = cut_at(folder / f"{name}.json", bounds, xs, ys)
        found = verify_zones(
            net, layout=layout, steps=steps, agents=12, background=100, overrides=FAST
        )
        (result,) = found.results
        assert result.difference is None, result
        assert result.crossings >= crossings


def roundabouts(net: Path, network: RoadNetwork) -> list[tuple[float, Place]]:
    """Return radius and centre of each roundabout, the largest first."""
    found = []
    for element in ElementTree.parse(net).iter("roundabout"):
        edges = [network.edge_ids.index(name) for name in element.attrib["edges"].split()]
        lanes = np.flatnonzero(np.isin(network.lanes["edge"], edges)).tolist()
        points = np.concatenate([network.lane_polyline(lane)[:, :2] for lane in lanes])
        middle = points.mean(axis=0)
        found.append((float(np.hypot(*(points - middle).T).mean()), middle))
    return sorted(found, key=lambda one: -one[0])


def bridges(network: RoadNetwork) -> Place:
    """Return (n, 2) points of lanes that are above or below other lanes."""
    lanes = [network.lane_polyline(lane) for lane in range(len(network.lanes))]
    points = np.concatenate(lanes)
    found = []
    for place in points:
        near = points[np.hypot(*(points[:, :2] - place[:2]).T) < NEAR_M]
        if np.ptp(near[:, 2]) > BRIDGE_M:
            found.append(place[:2])
    return np.array(found)


def test_a_border_through_a_roundabout_changes_no_result(
    built_map: Callable[[str], Path], tmp_path: Path
) -> None:
    net = built_map("osm/berlin_siegessaeule.osm.gz")
    radius, middle = roundabouts(net, load_network(net))[0]
    assert radius > 40.0
    equal_around(middle, net, tmp_path, crossings=10)


def test_a_border_through_a_bridge_changes_no_result(
    built_map: Callable[[str], Path], tmp_path: Path
) -> None:
    net = built_map("xodr/Town04.xodr")
    places = bridges(load_network(net))
    assert len(places)
    equal_around(places[len(places) // 2], net, tmp_path, crossings=5, steps=120)


@pytest.mark.parametrize("env", ["grid4x4", "town", "merge"])
def test_a_border_through_the_busiest_junction_changes_no_result(env: str, tmp_path: Path) -> None:
    net = find_map(env)
    network = load_network(net)
    internal = np.flatnonzero(network.lanes["internal"])
    junctions = network.edges["to_junction"][network.lanes["edge"][internal]]
    busiest = np.bincount(junctions).argmax()
    lanes = internal[junctions == busiest].tolist()
    points = np.concatenate([network.lane_polyline(lane)[:, :2] for lane in lanes])
    equal_around(points.mean(axis=0), net, tmp_path, crossings=5)
