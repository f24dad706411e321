"""What the needs of a way ask of a steered vehicle's place on its lane."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl.driving.kernels.lane_choice import MERGE_ROOM_M, SWAP_ROOM_M, room_for_more
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.roads.network import LANE
from cavmarl.roads.routing import PLAN


@pytest.mark.parametrize(
    ("changes", "length_m", "room_m"),
    [
        (1, 100.0, 0.0),
        (2, 100.0, 5.0 + SWAP_ROOM_M),
        (3, 100.0, 2.0 * (5.0 + SWAP_ROOM_M)),
        (3, 40.0, 0.25 * 40.0 - MERGE_ROOM_M),  # at most that share of a lane, with the first
        (3, 4.0, 0.0),
    ],
)
def test_each_further_change_of_lanes_has_room_of_its_own(
    changes: int, length_m: float, room_m: float
) -> None:
    lane, step = np.zeros(1, LANE)[0], np.zeros(1, PLAN)[0]
    lane["length_m"], step["changes"] = length_m, changes
    assert room_for_more(lane, blank_vehicle()[0], step) == pytest.approx(room_m)
