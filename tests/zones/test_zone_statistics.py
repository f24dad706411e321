from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.zones.partition.zone_partition import ZonePartition
from cavmarl.zones.partition.zone_statistics import imbalance, zone_statistics
from tests.naive import zones as naive
from tests.support.partitions import PINWHEEL

BOUNDS = (-110.0, -110.0, 110.0, 110.0)


@pytest.fixture
def cross(crossing: Callable[..., Path]) -> RoadNetwork:
    return read_network(crossing())


def halves(x: float) -> ZonePartition:
    rects = [[-110.0, -110.0, x, 110.0], [x, -110.0, 110.0, 110.0]]
    return ZonePartition(BOUNDS, np.array(rects))


def test_lane_lengths_are_counted_in_the_zones_that_they_cross(cross: RoadNetwork) -> None:
    # Each lane is 95 m long. In x, two lanes reach from -100 to -5, one lane from 5 to 100, and two
    # lanes run along x = 0.
    assert zone_statistics(halves(-50.0), cross).lane_km == pytest.approx((0.1, 0.375))
    assert zone_statistics(halves(50.0), cross).lane_km == pytest.approx((0.425, 0.05))


def test_a_lane_along_a_border_is_in_one_zone(cross: RoadNetwork) -> None:
    assert zone_statistics(halves(0.0), cross).lane_km == pytest.approx((0.19, 0.285))


@pytest.mark.parametrize(("x", "cut"), [(0.0, 1), (-30.0, 0), (-6.5, 1), (-6.7, 0), (6.7, 0)])
def test_a_junction_counts_as_cut_if_it_has_area_on_both_sides(
    cross: RoadNetwork, x: float, cut: int
) -> None:
    assert cross.lanes["width_m"][0] == 3.2
    found = zone_statistics(halves(x), cross)
    assert (found.junctions, found.junctions_cut) == (1, cut)
    assert found.cut_junctions == (cut, cut)


def test_counted_vehicles_and_ghosts_equal_the_twin(cross: RoadNetwork) -> None:
    xy = np.random.default_rng(0).uniform(-5.0, 35.0, (200, 2))
    xy[:4] = [[10.0, 10.0], [20.0, 20.0], [10.0, 20.0], [10.0, 15.0]]
    found = zone_statistics(PINWHEEL, cross, halo_m=5.0, positions=xy)
    owners = PINWHEEL.zones_of(xy)
    expected = [0] * PINWHEEL.count
    for zone in range(PINWHEEL.count):
        for other, rows in enumerate(
            naive.published(PINWHEEL.reaching, 5.0, xy[owners == zone], zone)
        ):
            expected[other] += len(rows)
    assert found.ghosts == tuple(expected)
    assert found.vehicles == tuple(np.bincount(owners))
    assert found.vehicle_imbalance == pytest.approx(max(found.vehicles) / 40.0)


def test_zones_narrower_than_the_halo_are_listed(cross: RoadNetwork) -> None:
    # Zones at the edge of the map reach to infinity, so only the middle zone can be too narrow.
    assert zone_statistics(PINWHEEL, cross, halo_m=10.0).narrow == ()
    assert zone_statistics(PINWHEEL, cross, halo_m=10.1).narrow == (4,)


def test_imbalance_is_maximum_over_mean() -> None:
    assert imbalance([2.0, 2.0]) == 1.0
    assert imbalance([4.0, 0.0]) == 2.0
    assert imbalance([0.0, 0.0]) == 1.0


def test_figures_can_be_written_as_json(cross: RoadNetwork) -> None:
    plain = zone_statistics(halves(0.0), cross).to_dict()
    assert plain["lane_imbalance"] == pytest.approx(1.2)
    assert plain["junctions_cut"] == 1
