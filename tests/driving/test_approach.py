from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.records.arrays import Scratch
from cavmarl.core.records.codes import HOLD_EXIT_BLOCKED
from cavmarl.core.records.rows import SIZE_LENGTHS_M
from cavmarl.driving.kernels.junctions.approach import register_links
from cavmarl.engine.simulation import Simulation
from cavmarl.roads.routing import PLAN
from tests.naive import approach as naive
from tests.support.driving import drive, make_traffic, start
from tests.support.netgenerate import netgenerate
from tests.support.traffic import scratch

CROWDS = {"merge": 30, "grid4x4": 40, "ring": 20, "blocks": 60}


@pytest.fixture(params=CROWDS, scope="module")
def world(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Simulation:
    """Return a world whose traffic has driven for 8 s."""
    env = request.param
    if env == "blocks":
        env = netgenerate(
            tmp_path_factory.mktemp("blocks") / "blocks.net.xml",
            "--grid", "--grid.number", "5", "--grid.length", "110",
            "--default-junction-type", "priority_stop", "--default.speed", "20",
        )  # fmt: skip
    simulation = make_traffic(env, background=CROWDS[request.param])
    start(simulation, seed=4)
    for _ in range(round(8.0 / simulation.config.clock.ctrl_dt_s)):
        drive(simulation)
    return simulation


def listed(simulation: Simulation, rows: NDArray[np.void]) -> Scratch:
    room = scratch(simulation.network, len(rows))
    travel = simulation.travel
    step, step_at = np.zeros(len(rows), PLAN), np.zeros(len(rows), np.int64)
    register_links(simulation.network.arrays, travel, rows, len(rows), step, step_at, room)
    return room


def entries(room: Scratch, link: int) -> list[tuple[int, float, float, float]]:
    """Return (id, distance to the line, speed, half length) of the vehicles that a link lists."""
    found = room.approach[room.link_start[link] : room.link_end[link]]
    assert (found["link"] == link).all()
    return sorted((int(e["id"]), float(e["dist"]), e["speed"], e["half"]) for e in found)


@pytest.mark.parametrize("stand", [False, True])
def test_every_link_lists_the_vehicles_on_the_link_and_before_its_line(
    world: Simulation, stand: bool
) -> None:
    """With `stand`, no vehicle can move; the links must also list standing vehicles."""
    travel, roads = world.travel, world.network
    for step in range(0, 12, 2):
        for _ in range(step):
            drive(world)
        rows = world.vehicles()
        if stand:
            rows["speed"], rows["hold"] = 0.0, HOLD_EXIT_BLOCKED
        room = listed(world, rows)
        expected: dict[int, list[tuple[int, float, float, float]]] = {}
        for row in rows:
            for link, name, dist in naive.announcements(roads, travel, row):
                entry = (name, dist, row["speed"], 0.5 * row["length"])
                expected.setdefault(link, []).append(entry)
        for link in range(len(roads.links)):
            twin = sorted(expected.get(link, []))
            assert len(entries(room, link)) == len(twin), link
            for mine, other in zip(entries(room, link), twin, strict=True):
                assert mine == pytest.approx(other)


def test_each_junction_has_the_largest_size_of_its_listed_vehicles(world: Simulation) -> None:
    rows, links = world.vehicles(), world.network.links
    rows["length"], rows["length"][::2] = 7.5, 12.0
    room = listed(world, rows)
    largest = np.zeros(len(world.network.junctions), np.int64)
    for link, junction in enumerate(links["junction"].tolist()):
        for _, _, _, half in entries(room, link):
            size = sum(2.0 * half > length for length in SIZE_LENGTHS_M)
            largest[junction] = max(largest[junction], size)
    assert largest.any()
    np.testing.assert_array_equal(room.largest, largest)


def test_the_order_of_rows_does_not_matter(world: Simulation) -> None:
    rows = world.vehicles()
    order = np.random.default_rng(1).permutation(len(rows))
    tidy, shuffled = listed(world, rows), listed(world, rows[order])
    np.testing.assert_array_equal(tidy.links.bounds, shuffled.links.bounds)
    for link in range(len(world.network.links)):
        assert entries(tidy, link) == entries(shuffled, link)
