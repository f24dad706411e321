from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.config.sensors import LanesConfig, SensorsConfig
from cavmarl.core.math.neighbors import fill_grid, make_grid
from cavmarl.core.records.arrays import TripTables
from cavmarl.core.records.codes import SIGNAL_RED, SIGNAL_RED_YELLOW
from cavmarl.driving.kernels.junctions.gaps import link_signal
from cavmarl.driving.kernels.motion.tracking import side_lane
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import make_plans
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.sensors.kernels.observing_lanes import LANES_FEATURES, observe_lanes
from cavmarl.sensors.observed import layout, sensor_arrays
from tests.naive import observing_lanes as naive
from tests.support.junction_scenes import build_crossing, with_shorter_lane
from tests.support.traffic import NAMES, crowds_on_lanes, network, on_lane, plans, travel, travel_by

RANGE_M = 60.0
CONFIG = SensorsConfig(lanes=LanesConfig(range_m=RANGE_M))


def observe(name: str, rows: NDArray[np.void], i: int, phase: NDArray[np.int32]) -> list[float]:
    return observed(network(name), travel(name), rows, i, phase)


def observed(
    roads: RoadNetwork, ways: TripTables, rows: NDArray[np.void], i: int, phase: NDArray[np.int32]
) -> list[float]:
    grid = make_grid(roads.extent_m, 25.0, len(rows))
    fill_grid(rows, len(rows), grid)
    place = layout(CONFIG)["lanes"]
    out = np.zeros(place.stop, np.float32)
    sensors = sensor_arrays(CONFIG, roads)
    observe_lanes(roads.arrays, ways, rows, i, grid, phase, sensors, out)
    assert place.stop - place.start == LANES_FEATURES
    assert not out[: place.start].any()
    return [float(value) for value in out[place]]


def phases(name: str, random: object) -> NDArray[np.int32]:
    """Return a random phase for each signal."""
    programs = network(name).programs[network(name).signals["program"]]
    found = [p["first_phase"] + random.randrange(p["num_phases"]) for p in programs]  # type: ignore[attr-defined]
    return np.array(found, dtype=np.int32)


def red_links(name: str, phase: NDArray[np.int32]) -> set[int]:
    roads = network(name)
    red = (SIGNAL_RED, SIGNAL_RED_YELLOW)
    links = range(len(roads.links))
    return {link for link in links if link_signal(roads.arrays, link, phase) in red}


@st.composite
def traffic(draw: st.DrawFn, name: str) -> NDArray[np.void]:
    """Draw vehicles at exact positions on lanes, with goals and speeds."""
    rows = draw(crowds_on_lanes(name, most=10))
    placed = [on_lane(network(name), row["lane"], row["s"])[0] for row in rows]
    for row, there in zip(rows, placed, strict=True):
        row["x"], row["y"], row["heading"] = there["x"], there["y"], there["heading"]
        # Draw a goal that the lane leads to. For other goals, the kernel and the twin differ: the
        # kernel continues along the lane, the twin does not.
        ways = plans(name)[:4, row["lane"]]["to_go"]
        row["goal"] = draw(st.sampled_from(np.flatnonzero(np.isfinite(ways)).tolist() or [0]))
        assume(np.isfinite(ways[row["goal"]]) or not network(name).lanes[row["lane"]]["internal"])
        row["way"] = row["goal"] * len(network(name).lanes)
        row["speed"] = draw(st.sampled_from([0.0, 3.0, 14.0]))
    return rows


@pytest.mark.parametrize("name", NAMES)
@settings(deadline=None)
@given(data=st.data(), random=st.randoms(use_true_random=False))
def test_lanes_equals_twin_for_any_order_of_rows(
    name: str, data: st.DataObject, random: object
) -> None:
    rows = data.draw(traffic(name))
    phase = phases(name, random)
    held = red_links(name, phase)
    order = data.draw(st.permutations(range(len(rows))))
    for place, i in enumerate(order):
        found = observe(name, rows, i, phase)
        assert found == observe(name, rows[order], place, phase)
        twin = naive.lanes(network(name), plans(name), rows, i, held, RANGE_M)
        assert found == pytest.approx(twin, abs=1e-6)


def test_gaps_on_a_straight_road_have_known_values() -> None:
    roads = network("merge")
    lane = roads.lane_ids.index("main_out_0")
    left = int(roads.lanes[lane]["left"])
    cars = [(lane, 100.0, 20.0), (lane, 115.0, 16.0), (lane, 140.0, 10.0), (left, 85.0, 24.0)]
    rows = np.concatenate([on_lane(roads, at, s, speed=speed) for at, s, speed in cars])
    rows["goal"] = len(plans("merge")) - 1
    rows["way"] = rows["goal"] * len(roads.lanes)
    rows["id"] = np.arange(len(rows))
    found = observe("merge", rows, 0, np.zeros(0, np.int32))
    assert found[:2] == pytest.approx([0.5, -0.1])
    assert found[2:4] == [0.0, 0.0]
    assert found[4:6] == pytest.approx([0.5, 0.1])
    assert found[6:] == [0.0] * 8


def test_a_vehicle_beyond_a_shorter_lane_is_observed_on_the_longer_lane_that_it_covers(
    tmp_path: Path,
) -> None:
    """The lane of its centre is in the junction, but its body covers the longer adjacent lane."""
    path = with_shorter_lane(build_crossing(tmp_path, "priority", side_lanes=2), "S_in_1", 8.0)
    roads = read_network(path)
    own, inside = (roads.lane_ids.index(lane) for lane in ("S_in_0", ":c_10_0"))
    steps = make_plans(roads, [roads.edge_ids.index("N_out")])
    ways = travel_by(steps)
    rows = np.concatenate(
        [on_lane(roads, own, 110.0, ways, id=0, goal=0), on_lane(roads, inside, 2.0, d=-2.8, id=1)]
    )
    rows["side_lane"][1] = side_lane(roads.arrays, rows[1])
    assert rows["side_lane"][1] == own
    found = observed(roads, ways, rows, 0, np.zeros(0, np.int32))
    apart_m = float(roads.lanes["length_m"][own]) - 8.0 + 2.0 - 110.0
    assert found[0] == pytest.approx(naive.closeness(apart_m - 5.0), abs=1e-3)
