from __future__ import annotations

import numpy as np

from cavmarl.config.registry import load_config, resolve_map
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_layouts import cut_map
from cavmarl.zones.partition.zone_loops import zones_without_loop


def entry(name: str) -> RoadNetwork:
    return load_network(resolve_map(*load_config(name)))


def test_points_of_lanes_and_lanes_of_edges_are_stored_in_order() -> None:
    network = entry("grid4x4")
    lanes, edges = network.lanes, network.edges
    assert (np.diff(lanes["first_point"]) == lanes["num_points"][:-1]).all()
    assert (np.diff(edges["first_lane"]) == edges["num_lanes"][:-1]).all()


def test_a_ring_is_a_loop_until_it_is_cut() -> None:
    ring = entry("ring")
    assert zones_without_loop(ring, cut_map(ring, "grid", 1)) == ()
    assert zones_without_loop(ring, cut_map(ring, "grid", 4)) == (0, 1, 2, 3)


def test_blocks_of_a_city_are_loops() -> None:
    city = entry("grid4x4")
    assert zones_without_loop(city, cut_map(city, "grid", 4)) == ()
    assert zones_without_loop(city, cut_map(city, "strips", 4)) != ()


def test_a_through_road_has_no_loop() -> None:
    merge = entry("merge")
    assert zones_without_loop(merge, cut_map(merge, "strips", 3)) == (0, 1, 2)
