"""Vehicles on lanes of bundled maps, for tests of kernels that need roads."""

from __future__ import annotations

from functools import cache

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.config.registry import load_config, resolve_map
from cavmarl.core.records.arrays import Scratch, TripTables
from cavmarl.core.records.rows import SIZE_LENGTHS_M
from cavmarl.driving.kernels.lanes.lane_index import VIEW_M
from cavmarl.driving.kernels.motion.motion import place_on_lane
from cavmarl.driving.vehicle_types import generated_types
from cavmarl.driving.vehicles import VEHICLE, blank_vehicle
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import PLAN, make_plans
from cavmarl.shards.shard import make_shard_scratch
from cavmarl.traffic.demand import STOP
from cavmarl.traffic.scenarios.movement_scripts import NO_SCRIPTS

NAMES = ("ring", "merge", "grid4x4")


@cache
def network(name: str) -> RoadNetwork:
    """Return the roads of an environment."""
    return load_network(resolve_map(*load_config(name)))


@cache
def plans(name: str) -> NDArray[np.void]:
    """Return PLAN (4, lanes): plans to four goals, which are edges spread over the network."""
    roads = network(name)
    outside = np.flatnonzero(~roads.edges["internal"])
    picks = np.linspace(0, len(outside) - 1, 4).astype(int)
    return make_plans(roads, [int(edge) for edge in outside[picks]])


def travel_by(
    steps: NDArray[np.void],
    types: NDArray[np.void] | None = None,
    stops: NDArray[np.void] | None = None,
) -> TripTables:
    """Return trip tables with these plans; the defaults are the generator's type and no stops."""
    return TripTables(
        generated_types() if types is None else types,
        steps.reshape(-1),
        np.zeros(0, STOP) if stops is None else stops,
        first_detour=0,
        begin_s=0.0,
        view_m=VIEW_M,
        see_m=VIEW_M,
        num_fixed=steps.size,
        scripts=NO_SCRIPTS,
        shifts=np.zeros(64, dtype=np.int64),
    )


@cache
def travel(name: str) -> TripTables:
    """Return trip tables with the type of the generator and the four plans of `plans`."""
    return travel_by(plans(name))


def scratch(roads: RoadNetwork, capacity: int) -> Scratch:
    """Return scratch memory in which each junction may have vehicles of any size."""
    room = make_shard_scratch(roads, capacity)
    room.largest[:] = len(SIZE_LENGTHS_M)
    return room


def on_lane(
    roads: RoadNetwork, lane: int, s: float, travel: TripTables | None = None, **fields: object
) -> NDArray[np.void]:
    """Return VEHICLE (1,): a car on a lane, on the plan to its goal if `travel` is given."""
    row = blank_vehicle()
    row["lane"], row["target_lane"], row["s"] = lane, lane, s
    for field, value in fields.items():
        row[field] = value
    if travel is None:
        nowhere = np.zeros(len(roads.lanes), PLAN)
        nowhere["next"] = -1
        travel = travel_by(nowhere)
    elif "way" not in fields:
        row["way"] = row["goal"] * len(roads.lanes)
    heading = place_on_lane(roads.arrays, travel, row[0])
    if "heading" not in fields:
        row["heading"] = heading
    return row


@st.composite
def crowds_on_lanes(draw: st.DrawFn, name: str, most: int = 24) -> NDArray[np.void]:
    """Draw cars on a few lanes; many cars have equal positions, and ids are in random order."""
    roads = network(name)
    lanes = draw(st.lists(st.integers(0, len(roads.lanes) - 1), min_size=1, max_size=5))
    places = draw(
        st.lists(
            st.tuples(
                st.sampled_from(lanes), st.integers(0, 4), st.booleans(), st.sampled_from([0, 14])
            ),
            min_size=1,
            max_size=most,
        )
    )
    rows = np.zeros(len(places), VEHICLE)
    rows["id"] = draw(st.permutations(range(len(places))))
    for row, (lane, quarter, astride, speed) in zip(rows, places, strict=True):
        here = roads.lanes[lane]
        row["lane"], row["s"] = lane, 0.25 * quarter * here["length_m"]
        row["side_lane"] = max(here["left"], here["right"]) if astride else -1
        row["length"], row["speed"] = 5.0, speed
    return rows
