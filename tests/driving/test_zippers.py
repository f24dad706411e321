"""Zipper merging of two lanes: vehicles take turns, and no vehicle stops."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.records.codes import HOLD_EXIT_BLOCKED, HOLD_NONE, HOLD_YIELD
from cavmarl.driving.kernels.junctions.approach import APPROACH
from cavmarl.driving.kernels.junctions.gaps import is_minor
from cavmarl.driving.kernels.junctions.zippers import is_zipper, passes_first
from cavmarl.evaluate.traffic.native_side import idle_commands, make_world
from cavmarl.evaluate.traffic.traffic_comparison import compare_traffic
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import PLAN
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.builders import vehicles
from tests.support.narrow_places import zipper
from tests.support.netgenerate import netgenerate
from tests.support.traffic import travel_by

NO_PHASE = np.zeros(0, dtype=np.int32)


@pytest.fixture(scope="module")
def roads(tmp_path_factory: pytest.TempPathFactory) -> RoadNetwork:
    return read_network(zipper(tmp_path_factory.mktemp("zipper"))[0])


@pytest.mark.parametrize(("per_h", "kind"), [(500, "car"), (900, "car"), (550, "mix")])
def test_no_vehicle_stops_at_a_zipper(tmp_path: Path, per_h: int, kind: str) -> None:
    world = make_world(*_files(tmp_path, per_h, kind), 300, 1, 0.1)
    commands, slowest = idle_commands(world), np.inf
    for _ in range(3000):
        world.step(commands)
        rows = world.vehicles()
        assert (rows["hit"] < 0).all()
        slowest = min(slowest, float(rows["speed"].min(initial=np.inf)))
    assert slowest > 2.0
    assert world.traffic_stats().arrived > 0.8 * world.traffic_stats().departed


def test_in_dense_traffic_vehicles_of_both_lanes_take_turns(tmp_path: Path) -> None:
    world = make_world(*_files(tmp_path, 1500, "car"), 300, 1, 0.1)
    lanes, commands = world.network.lane_ids, idle_commands(world)
    came_from: dict[int, str] = {}
    order: list[str] = []
    for _ in range(3000):
        world.step(commands)
        for row in world.vehicles():
            assert row["hit"] < 0
            lane = lanes[row["lane"]]
            if lane.startswith("ab"):
                came_from[int(row["id"])] = lane
            elif int(row["id"]) in came_from:
                order.append(came_from.pop(int(row["id"])))
    assert len(order) > 100
    assert sum(one == other for one, other in pairwise(order[20:])) < 5


def _files(folder: Path, per_h: int, kind: str) -> tuple[Path, list[Path]]:
    net, routes = zipper(folder, per_h, kind)
    return net, [routes]


def test_the_flow_at_a_zipper_equals_sumos_flow(tmp_path: Path) -> None:
    net, routes = _files(tmp_path, 500, "car")
    found = compare_traffic(net, routes, seconds=300, seed=1)
    assert found.ours.figures.contacts == 0
    assert found.ratio("arrived") == pytest.approx(1.0, abs=0.1)
    assert found.ratio("mean_speed_mps") == pytest.approx(1.0, abs=0.15)
    assert found.ours.figures.mean_delay_s is not None
    assert found.ours.figures.mean_delay_s < 2.5, "the delay is far above SUMO's 2.0 s"


class Pair(NamedTuple):
    """Two vehicles before a zipper, one per lane, with the row of APPROACH of each."""

    rows: NDArray[np.void]
    links: list[int]
    foes: NDArray[np.void]


def pair(
    roads: RoadNetwork, to_line: tuple[float, float], speeds: tuple[float, float], **fields: object
) -> Pair:
    links = [int(link) for link in np.flatnonzero(roads.links["state"] == ord("Z"))]
    given_fields = {"id": range(2), "speed": speeds, "length": 5.0, **fields}
    rows = vehicles([(0.0, 0.0, 0.0)] * 2, **given_fields)
    foes = np.zeros(2, APPROACH)
    for k in range(2):
        foes[k] = (links[k], k, to_line[k] + 2.5, speeds[k], 2.5, k)
    return Pair(rows, links, foes)


def first(roads: RoadNetwork, two: Pair) -> list[bool]:
    """Return for each driver whether it lets the other vehicle pass first."""
    travel = travel_by(np.zeros(len(roads.lanes), PLAN))
    to_line = two.foes["dist"] - two.foes["half"]
    return [
        passes_first(
            roads.arrays, travel, two.rows, two.rows[k], two.links[k], to_line[k], two.foes[1 - k]
        )
        for k in range(2)
    ]


@settings(max_examples=200, deadline=None)
@given(
    to_line=st.tuples(st.floats(0.01, 120.0), st.floats(0.01, 120.0)),
    speeds=st.tuples(st.floats(0.0, 30.0), st.floats(0.0, 30.0)),
)
def test_both_drivers_at_a_zipper_compute_the_same_order(
    roads: RoadNetwork, to_line: tuple[float, float], speeds: tuple[float, float]
) -> None:
    assert sorted(first(roads, pair(roads, to_line, speeds))) == [False, True]


def test_the_vehicle_ahead_goes_first_then_the_faster_then_the_smaller_id(
    roads: RoadNetwork,
) -> None:
    assert first(roads, pair(roads, (10.0, 30.0), (8.0, 12.0))) == [False, True]
    assert first(roads, pair(roads, (30.0, 29.0), (12.0, 2.0))) == [False, True]
    assert first(roads, pair(roads, (20.0, 20.0), (8.0, 8.0))) == [False, True]


@pytest.mark.parametrize(
    ("fields", "goes"),
    [
        ({"hold": (HOLD_EXIT_BLOCKED, HOLD_NONE)}, False),
        ({"hold": (HOLD_YIELD, HOLD_NONE)}, True),
        ({"wait_s": (4.0, 0.0)}, False),  # the vehicle stands without a reason
        ({"to_go": (2.0, np.inf)}, False),  # the trip of the vehicle ends before the line
    ],
)
def test_a_driver_at_a_zipper_ignores_a_vehicle_that_cannot_go_on(
    roads: RoadNetwork, fields: dict[str, object], goes: bool
) -> None:
    two = pair(roads, (1.0, 6.0), (0.0, 3.0), **fields)
    assert first(roads, two)[1] == goes


def test_a_driver_approaches_a_zipper_without_being_ready_to_stop(roads: RoadNetwork) -> None:
    for link in np.flatnonzero(roads.links["state"] == ord("Z")):
        assert is_zipper(roads.arrays, link)
        assert not is_minor(roads.arrays, link, NO_PHASE)


def test_no_vehicle_waits_for_ever_where_zipper_links_cross(tmp_path: Path) -> None:
    options = ("--grid", "--grid.number=2", "--grid.length=80", "--grid.attach-length=120", "-L=2")
    net = netgenerate(tmp_path / "grid.net.xml", *options, "-j=zipper")
    assert (read_network(net).links["state"] == ord("Z")).any()
    flows = {"left0A0": "B1right1", "bottom0A0": "A1top0", "right1B1": "B0bottom1"}
    flows |= {"top1B1": "A1left1", "right0B0": "A0left0", "left1A1": "B1top1"}
    demand = tmp_path / "x.rou.xml"
    demand.write_text(
        "<routes>"
        + "".join(
            f'<flow id="{start}" from="{start}" to="{end}" begin="0" end="300" period="10"/>'
            for start, end in flows.items()
        )
        + "</routes>"
    )
    world = make_world(net, [demand], 400, 1, 0.1)
    commands = idle_commands(world)
    for _ in range(4000):
        world.step(commands)
        assert (world.vehicles()["hit"] < 0).all()
        assert world.vehicles()["wait_s"].max(initial=0.0) < 60.0
    stats = world.traffic_stats()
    assert (stats.departed, stats.arrived) == (180, 180)
