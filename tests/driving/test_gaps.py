"""Which gaps a driver accepts at a junction, by its limits in seconds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_BACKGROUND, HOLD_YIELD, SIGNAL_NONE
from cavmarl.driving.kernels.approach import APPROACH
from cavmarl.driving.kernels.junctions import _foe_blocks, _ignores
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.builders import vehicles
from tests.support.crossing import crossing
from tests.support.traffic import on_lane

__all__ = ["crossing"]

SPEED_MPS = 10.0  # of both, all along: it is the limit
HALF_M = 2.5

Blocks = Callable[[float, str, float], bool]


@pytest.fixture
def blocks(crossing: Callable[..., Path]) -> Blocks:
    """Whether a car from the west blocks one from the south, which gives way to it."""
    network = read_network(crossing())
    from_south, from_west = 1, 0
    first = int(network.links["first_conflict"][from_south])
    conflicts = network.conflicts[first : first + int(network.links["num_conflicts"][from_south])]
    (shared,) = conflicts[conflicts["foe"] == from_west]
    row = on_lane(network, network.lane_ids.index("s_0"), 0.0, speed=SPEED_MPS, length=2.0 * HALF_M)

    def ask(own_s: float, end: str, foe_m: float) -> bool:
        """Of the area that both ways share, by how long and how far they are before it.

        `own_s`: until the own front enters it, or the own rear leaves it, as `end` says. `foe_m`:
        of the other one's front to it; negative: of its rear to its end.
        """
        foe = np.zeros(1, APPROACH)
        foe["link"], foe["row"], foe["half"], foe["speed"] = from_west, 1, HALF_M, SPEED_MPS
        inside = foe_m < 0.0
        foe["dist"] = -shared["foe_leave_m"] - HALF_M - foe_m if inside else foe_m + HALF_M
        to_area = float(shared["enter_m"]) - HALF_M
        if end == "leave":
            to_area = float(shared["leave_m"]) + HALF_M
        if not inside:
            foe["dist"] -= shared["foe_enter_m"]
        distance = own_s * SPEED_MPS - to_area
        return bool(
            _foe_blocks(
                network.arrays, np.concatenate([row, row]), row[0], from_south, distance,
                SPEED_MPS, shared, foe[0], True, np.zeros(1, np.int32),
            )
        )  # fmt: skip

    return ask


def test_behind_one_that_is_on_the_junction_half_a_second_is_enough(blocks: Blocks) -> None:
    # Its rear leaves the shared area in 0.6 s.
    assert blocks(1.05, "enter", -6.0)
    assert not blocks(1.15, "enter", -6.0)


def test_behind_one_that_comes_it_is_a_second(blocks: Blocks) -> None:
    # It reaches the shared area of 5.5 m in 2 s, and with its 5 m it has left it in 3.05 s.
    assert blocks(4.0, "enter", 20.0)
    assert not blocks(4.1, "enter", 20.0)


def test_before_one_that_comes_it_is_a_second(blocks: Blocks) -> None:
    # Its front reaches the shared area in 4 s.
    assert blocks(3.05, "leave", 40.0)
    assert not blocks(2.95, "leave", 40.0)


@pytest.mark.parametrize(
    ("own_wait_s", "foe_wait_s", "own_id", "speed", "goes"),
    [
        (0.6, 0.2, 5, 0.0, True),
        (0.4, 0.2, 5, 0.0, False),  # it has not stood for half a second
        (0.6, 0.7, 0, 0.0, False),
        (0.6, 0.6, 0, 0.0, True),
        (0.6, 0.6, 5, 0.0, False),
        (0.6, 0.2, 5, 1.0, False),  # it moves
    ],
)
def test_of_two_that_give_way_to_each_other_the_one_goes_that_has_stood_longer(
    own_wait_s: float, foe_wait_s: float, own_id: int, speed: float, goes: bool
) -> None:
    row, foe = vehicles(
        [(0.0, 0.0, 0.0)] * 2,
        id=[own_id, 3],
        wait_s=[own_wait_s, foe_wait_s],
        speed=[speed, 0.0],
        hold=HOLD_YIELD,
    )
    assert _ignores(row, foe, 0, 1, SIGNAL_NONE) == goes


@pytest.mark.parametrize(("stopped_at", "goes"), [(1, True), (2, False)])
def test_an_agent_that_stands_at_its_stop_line_gives_way(stopped_at: int, goes: bool) -> None:
    row, foe = vehicles(
        [(0.0, 0.0, 0.0)] * 2,
        id=[5, 3],
        wait_s=[0.6, 0.2],
        speed=0.0,
        driver=[DRIVER_BACKGROUND, DRIVER_AGENT],
        stopped_at=[-1, stopped_at],
    )
    assert _ignores(row, foe, 0, 1, SIGNAL_NONE) == goes
