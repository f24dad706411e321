"""Partitions that follow the measured costs of zones."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import find_map
from cavmarl.handoff.repartition_plan import propose_zones
from cavmarl.roads.cache import load_network
from cavmarl.zones.partition.zone_layouts import cut_map
from cavmarl.zones.partition.zone_partition import ZonePartition


@pytest.fixture(scope="module")
def town() -> tuple[object, np.ndarray]:
    """Return roads, and positions of vehicles, most of them in one corner."""
    network = load_network(find_map("grid4x4"))
    min_x, min_y, max_x, max_y = network.extent_m
    draw = np.random.default_rng(5)
    everywhere = draw.uniform((min_x, min_y), (max_x, max_y), (60, 2))
    corner = draw.uniform((min_x, min_y), (min_x + 100.0, min_y + 100.0), (240, 2))
    return network, np.vstack([everywhere, corner])


def test_a_new_partition_follows_the_measured_costs(town: tuple[object, np.ndarray]) -> None:
    network, places = town
    partition = cut_map(network, "grid", 4)  # type: ignore[arg-type]
    counts = np.bincount(partition.zones_of(places), minlength=4)
    found = propose_zones(network, partition, places, (counts * 1e-6).tolist())  # type: ignore[arg-type]
    assert found is not None
    assert found.partition.count == 4
    assert found.after < 1.2 < 2.0 < found.before
    moved = (found.partition.zones_of(places) != partition.zones_of(places)).sum()
    assert found.moved == moved > 0


def test_new_zones_keep_old_numbers_if_possible(town: tuple[object, np.ndarray]) -> None:
    network, places = town
    halves = cut_map(network, "strips", 2)  # type: ignore[arg-type]
    for rects in (halves.rects, halves.rects[::-1]):
        first = ZonePartition(halves.bounds, rects)
        counts = np.bincount(first.zones_of(places), minlength=2)
        found = propose_zones(network, first, places, counts.tolist())  # type: ignore[arg-type]
        assert found is not None
        assert found.moved < len(places) / 2


def test_zones_do_not_change_if_the_gain_is_small(town: tuple[object, np.ndarray]) -> None:
    network, places = town
    first = cut_map(network, "grid", 4)  # type: ignore[arg-type]
    counts = np.bincount(first.zones_of(places), minlength=4)
    better = propose_zones(network, first, places, counts.tolist())  # type: ignore[arg-type]
    assert better is not None
    again = np.bincount(better.partition.zones_of(places), minlength=4)
    assert propose_zones(network, better.partition, places, again.tolist()) is None  # type: ignore[arg-type]
    assert propose_zones(network, first, places[:0], [0.0] * 4) is None  # type: ignore[arg-type]
    one_place = np.repeat(places[:1], 50, axis=0)
    costs = np.bincount(first.zones_of(one_place), minlength=4).tolist()
    assert propose_zones(network, first, one_place, costs) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("costs", [[1.0] * 3, [1.0, 1.0, 1.0, float("nan")], [1.0, 1.0, 1.0, -1.0]])
def test_a_missing_cost_of_a_zone_is_refused(
    town: tuple[object, np.ndarray], costs: list[float]
) -> None:
    network, places = town
    with pytest.raises(ConfigError, match="for each of 4 zones"):
        propose_zones(network, cut_map(network, "grid", 4), places, costs)  # type: ignore[arg-type]
