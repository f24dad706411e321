"""Deadlocks of vehicles that wait for one another in a circle, and how drivers resolve them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.records.arrays import Scratch
from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    HOLD_NONE,
    HOLD_YIELD,
    MODEL_IDM,
    MODEL_KRAUSS,
)
from cavmarl.driving.kernels.junctions.deadlocks import (
    is_deadlocked,
    resolves_deadlocks,
    yields_in_deadlock,
)
from cavmarl.driving.vehicle_types import set_model
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.builders import vehicles
from tests.support.junction_scenes import build_crossing
from tests.support.traffic import scratch, travel

AHEAD = {"W": "E", "E": "W", "S": "N", "N": "S"}
LEFT = {"W": "N", "N": "E", "E": "S", "S": "W"}
TICKS = 2000


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that builds a crossing with the given SUMO type of junction."""
    return partial(build_crossing, tmp_path_factory.mktemp("crossings"))


class Queue(NamedTuple):
    """Vehicles that stand and yield at the stop lines of a crossing."""

    network: RoadNetwork
    links: list[int]
    rows: NDArray[np.void]
    room: Scratch

    def yields(self, tick: int = 0, i: int = 0, asking: int = 0) -> bool:
        self.rows["tick"] = tick
        row, link = self.rows[i], self.links[i]
        return yields_in_deadlock(
            self.network.arrays, self.rows, row, link, self.rows[asking], self.room
        )

    def is_circle(self) -> bool:
        return is_deadlocked(self.network.arrays, self.rows, self.links[0], self.room)


@pytest.fixture
def queue(crossing: Callable[[str], Path]) -> Callable[..., Queue]:
    network = read_network(crossing("right_before_left"))

    def wait(arms: str, goals: dict[str, str], **fields: Any) -> Queue:
        lanes, links = network.lane_ids, network.links
        chosen = [
            int(link)
            for arm in arms
            for link in np.flatnonzero(links["from_lane"] == lanes.index(f"{arm}_in_0"))
            if lanes[links["to_lane"][link]] == f"{goals[arm]}_out_0"
        ]
        assert len(chosen) == len(arms)
        given = {"hold": HOLD_YIELD, "wait_s": 1.0, "speed": 0.0, "id": range(len(arms))}
        rows = vehicles([(0.0, 0.0, 0.0)] * len(arms), **{**given, **fields})
        room = scratch(network, len(arms))
        for k, link in enumerate(chosen):
            room.link_start[link], room.link_end[link] = k, k + 1
            room.approach[k]["link"], room.approach[k]["row"] = link, k
            room.approach[k]["half"], room.approach[k]["dist"] = 2.5, 2.6
            room.approach[k]["id"] = k
        return Queue(network, chosen, rows, room)

    return wait


@pytest.mark.parametrize(
    ("arms", "goals", "circle"),
    [
        ("WSEN", AHEAD, True),
        ("WS", AHEAD, False),
        ("WSE", AHEAD, False),  # the vehicle from the east yields to no other vehicle
        ("WE", LEFT, False),
        ("WSE", LEFT, True),  # a left turn from the east yields to the vehicle from the west
    ],
)
def test_a_chain_of_waiting_vehicles_is_a_deadlock_if_it_is_closed(
    queue: Callable[..., Queue], arms: str, goals: dict[str, str], circle: bool
) -> None:
    assert queue(arms, goals).is_circle() == circle


@pytest.mark.parametrize(("goals", "share"), [(AHEAD, 0.25), (LEFT, 0.75)])
def test_all_drivers_compute_the_same_ticks_in_which_a_vehicle_of_a_deadlock_yields(
    queue: Callable[..., Queue], goals: dict[str, str], share: float
) -> None:
    here = queue("WSEN", goals)
    drawn = [here.yields(tick) for tick in range(TICKS)]
    assert np.mean(drawn) == pytest.approx(share, abs=0.03)
    assert [here.yields(tick, asking=3) for tick in range(TICKS)] == drawn
    assert [here.yields(tick, i=1) for tick in range(TICKS)] != drawn, (
        "two vehicles yield in the same ticks"
    )


@pytest.mark.parametrize(
    "fields",
    [{"hold": HOLD_NONE}, {"speed": 1.0}, {"wait_s": 0.0}],
)
def test_a_vehicle_that_does_not_wait_does_not_yield_in_a_deadlock(
    queue: Callable[..., Queue], fields: dict[str, Any]
) -> None:
    here = queue("WSEN", AHEAD, **fields)
    assert not any(here.yields(tick) for tick in range(100))


@pytest.mark.parametrize(
    ("kind", "driver", "model", "breaks"),
    [
        ("right_before_left", DRIVER_BACKGROUND, MODEL_KRAUSS, True),
        ("right_before_left", DRIVER_BACKGROUND, MODEL_IDM, False),
        ("right_before_left", DRIVER_AGENT, MODEL_KRAUSS, False),
        ("priority", DRIVER_BACKGROUND, MODEL_KRAUSS, False),
    ],
)
def test_only_background_drivers_with_krauss_on_equal_roads_resolve_deadlocks(
    crossing: Callable[[str], Path], kind: str, driver: int, model: int, breaks: bool
) -> None:
    network = read_network(crossing(kind))
    tables = travel("grid4x4")
    types = np.array(tables.types)
    set_model(types, model)
    (row,) = vehicles([(0.0, 0.0, 0.0)], driver=driver)
    lanes = [network.lane_ids[lane] for lane in network.links["to_lane"]]
    links = [
        k
        for k, lane in enumerate(network.links["from_lane"])
        if network.lane_ids[lane] == "S_in_0" and lanes[k] == "N_out_0"
    ]
    tables = tables._replace(types=types)
    assert resolves_deadlocks(network.arrays, tables, row, links[0]) == breaks
