"""The watchers of a lane are the zones that get ghosts of the vehicles on the lane."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    HOLD_EXIT_BLOCKED,
    HOLD_NONE,
    HOLD_SIGNAL,
    HOLD_YIELD,
)
from cavmarl.core.records.rows import MERGES_M
from cavmarl.driving.kernels.junctions.stop_line_registration import registration_distance_m
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.kernels.borders import Borders
from cavmarl.zones.kernels.ghost_exchange import exchange, gather
from cavmarl.zones.kernels.ownership_changes import make_book
from cavmarl.zones.kernels.zone_lookup import LOOK, Halo
from cavmarl.zones.partition.zone_halo import inner_parts, lane_watchers, zone_halo
from cavmarl.zones.partition.zone_layouts import cut_map
from cavmarl.zones.partition.zone_partition import ZonePartition
from tests.naive import zones as naive
from tests.support.builders import vehicles
from tests.support.traffic import network
from tests.support.watchers import blank_looks, looks_of
from tests.support.zoned import SIDE, ghosts_of, zoned_of

SURE_M, SEEN_M, ASIDE_M, LINE_M = 12.0, 90.0, 10.0, 4.0
VEHICLES = 150


def random_looks(
    rng: np.random.Generator, roads: RoadNetwork, partition: ZonePartition
) -> tuple[Halo, NDArray[np.void]]:
    """Draw the parts of lanes that zones look at; 20 % of the fields of LOOK have a position."""
    looks = blank_looks((partition.count, len(roads.lanes)))
    length = roads.lanes["length_m"]
    for field in LOOK.names or ():
        nothing = -np.inf if field == "head" else np.inf
        place = rng.uniform(0.0, 1.0, looks.shape) * length
        looks[field] = np.where(rng.random(looks.shape) < 0.2, place, nothing)
    start, watchers = lane_watchers(partition, roads.lanes, looks, SURE_M + ASIDE_M)
    halo = zone_halo(partition, 2.0 * SEEN_M)._replace(
        inner=inner_parts(partition, SEEN_M),
        sure_m=SURE_M,
        seen_m=SEEN_M,
        line_m=LINE_M,
        watcher_start=start,
        watchers=watchers,
    )
    return halo, looks


def random_rows(
    rng: np.random.Generator, roads: RoadNetwork, partition: ZonePartition
) -> list[NDArray[np.void]]:
    """Draw rows of each zone: background vehicles near their lanes, agents anywhere."""
    lanes = rng.integers(0, len(roads.lanes), VEHICLES)
    rows = vehicles([(0.0, 0.0, 0.0)] * VEHICLES, id=100 + np.arange(VEHICLES))
    rows["lane"] = lanes
    rows["s"] = rng.uniform(0.0, 1.0, VEHICLES) * roads.lanes["length_m"][lanes]
    rows["speed"] = rng.choice([0.0, 14.0], VEHICLES)
    rows["hold"] = rng.choice([HOLD_NONE, HOLD_SIGNAL, HOLD_YIELD, HOLD_EXIT_BLOCKED], VEHICLES)
    rows["wait_s"] = rng.choice([1.0, 9.0], VEHICLES)
    rows["driver"] = rng.choice([DRIVER_BACKGROUND, DRIVER_AGENT], VEHICLES, p=[0.8, 0.2])
    min_x, min_y, max_x, max_y = roads.extent_m
    for row in rows:
        lane = roads.lanes[row["lane"]]
        points = roads.points[lane["first_point"] :][: lane["num_points"]]
        angle, off_m = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.0, ASIDE_M)
        row["x"] = np.interp(row["s"], points["s"], points["x"]) + off_m * np.cos(angle)
        row["y"] = np.interp(row["s"], points["s"], points["y"]) + off_m * np.sin(angle)
        if row["driver"] == DRIVER_AGENT:
            row["x"], row["y"] = rng.uniform(min_x, max_x), rng.uniform(min_y, max_y)
    owners = [naive.owners(partition.reaching, row["x"], row["y"])[0] for row in rows]
    return [rows[[owner == zone for owner in owners]] for zone in range(partition.count)]


def expected_of(
    looks: NDArray[np.void], partition: ZonePartition, zone: int, others: list[np.void]
) -> list[int]:
    """Return the ids of the vehicles whose ghosts a zone needs, by definition."""
    near = {int(row["id"]) for row in naive.within(partition.reaching[zone], SURE_M, others)}
    found = []
    for row in naive.within(partition.reaching[zone], SEEN_M, others):
        look, s = looks[zone, row["lane"]], row["s"]
        asked = s <= look["head"] or s >= look["tail"] or int(row["id"]) in near
        reach_m = registration_distance_m(row["speed"])
        coming = look["line"] - s < reach_m
        idle = row["hold"] in (HOLD_SIGNAL, HOLD_EXIT_BLOCKED)
        idle |= row["hold"] == HOLD_NONE and row["wait_s"] > 3.0
        idle &= row["speed"] == 0.0
        unseen = idle and row["driver"] == DRIVER_BACKGROUND
        coming &= not unseen or look["line"] - s <= LINE_M
        coming |= look["back"] - s < reach_m or look["room"] - s < reach_m
        coming |= not idle and look["merge"] - s < MERGES_M
        if asked or coming:
            found.append(int(row["id"]))
    return sorted(found)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("zones", [2, 4, 9])
def test_zones_get_exactly_the_ghosts_that_they_need(seed: int, zones: int) -> None:
    rng, roads = np.random.default_rng(seed), network("grid4x4")
    partition = cut_map(roads, "grid", zones)
    halo, looks = random_looks(rng, roads, partition)
    parts = random_rows(rng, roads, partition)
    sent, gathered = zoned_of(parts), zoned_of(parts)
    arrays, touching_m, border_m = partition.arrays, 5.0, 8.0
    sent.num_outer[:] = -1
    book = make_book(1, VEHICLES * zones)
    borders = Borders(border_m, 1.0, border_m)
    exchange(arrays, halo, touching_m, borders, sent, SIDE, 0, 1, book)
    gathered.num_outer[:] = -1
    seen = 0
    for zone in range(zones):
        gather(arrays, halo, touching_m, border_m, gathered, SIDE, zone, 0)
        others = [row for other, part in enumerate(parts) if other != zone for row in part]
        expected = expected_of(looks, partition, zone, others)
        for zoned in (sent, gathered):
            assert sorted(ghosts_of(zoned, zone)["id"].tolist()) == expected
        seen += len(expected)
    assert 0.05 * VEHICLES < seen < (zones - 1) * VEHICLES


def test_zones_watch_the_lanes_that_their_drivers_look_at_and_nearby_lanes() -> None:
    roads = network("grid4x4")
    partition = cut_map(roads, "grid", 4)
    looks = blank_looks((4, len(roads.lanes)))
    # The lane that is farthest from zone 0, which is at the origin.
    far = int(np.argmax(roads.lanes["min_x"] + roads.lanes["min_y"]))
    looks["line"][0, far] = 3.0
    start, watchers = lane_watchers(partition, roads.lanes, looks, 20.0)
    halo = zone_halo(partition, 100.0)._replace(watcher_start=start, watchers=watchers)
    assert [looks_of(halo, zone).tolist() for zone in range(4)] == looks.tolist()
    for lane, box in enumerate(roads.lanes):
        corners = np.array([box["min_x"], box["min_y"], box["max_x"], box["max_y"]])
        for zone, rect in enumerate(partition.reaching):
            apart = np.maximum(np.maximum(rect[:2] - corners[2:], corners[:2] - rect[2:]), 0.0)
            watches = zone in watchers["zone"][start[lane] : start[lane + 1]]
            assert watches == (np.hypot(*apart) <= 20.0 or (zone, lane) == (0, far))
