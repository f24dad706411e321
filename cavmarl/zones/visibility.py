"""`Visibility` computes which vehicles zones see beyond their borders, for any partition."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cavmarl.core.huge_pages import huge_copy
from cavmarl.core.records.arrays import TripTables
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.kernels.visibility_scratch import make_scratch
from cavmarl.zones.kernels.visibility_tests import AT_LINE_M, farthest_m, find_looks
from cavmarl.zones.kernels.zone_lookup import LOOK, Halo
from cavmarl.zones.partition.zone_halo import inner_parts, lane_watchers, zone_halo
from cavmarl.zones.partition.zone_partition import ZonePartition
from cavmarl.zones.reach import off_lane_m


@dataclass(frozen=True, eq=False)
class Visibility:
    """The distances and the roads that limit how far zones see."""

    network: RoadNetwork
    travel: TripTables  # the types of vehicles, and how far drivers look
    halo_m: float  # zones see no vehicles farther away
    sure_m: float  # zones see all nearer vehicles; if equal to `halo_m`, roads have no influence
    outside_m: float  # how far a vehicle can be outside of its zone while its transfer is late

    def halo(self, partition: ZonePartition) -> Halo:
        halo = zone_halo(partition, self.halo_m)
        if partition.count == 1 or self.sure_m >= self.halo_m:
            return halo
        roads = self.network.arrays
        scratch = make_scratch(len(roads.lanes), len(roads.links))
        half_m = 0.5 * float(self.travel.types["length"].max())
        aside_m = off_lane_m(self.network, self.travel)
        wide_m = self.outside_m + aside_m  # how far outside of its zone a vehicle's lane can be
        rects = partition.reaching + np.array([-wide_m, -wide_m, wide_m, wide_m])
        looks = np.zeros((partition.count, len(roads.lanes)), dtype=LOOK)
        seen_m = self.sure_m
        for zone, (rect, own) in enumerate(zip(rects, looks, strict=True)):
            find_looks(roads, rect, self.travel.view_m, self.travel.see_m, half_m, scratch, own)
            seen_m = max(seen_m, aside_m + farthest_m(roads, partition.arrays.rects, zone, own))
        seen_m = min(seen_m, self.halo_m)
        start, watchers = lane_watchers(partition, roads.lanes, looks, self.sure_m + aside_m)
        return halo._replace(
            inner=inner_parts(partition, seen_m),
            sure_m=float(self.sure_m),
            seen_m=float(seen_m),
            line_m=half_m + float(roads.lanes["stop_back_m"].max()) + AT_LINE_M,
            watcher_start=huge_copy(start),
            watchers=huge_copy(watchers),
        )
