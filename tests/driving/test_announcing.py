"""Announcements of vehicles that come, and vehicles that are not waited for."""

from __future__ import annotations

import pytest

from cavmarl.core.records.codes import HOLD_EXIT_BLOCKED, HOLD_NONE, HOLD_SIGNAL, HOLD_YIELD
from cavmarl.driving.kernels.announcing import announced_m, is_let_stand
from tests.support.builders import vehicles


@pytest.mark.parametrize(("speed", "expected"), [(0.0, 30.0), (5.0, 70.0), (20.0, 150.0)])
def test_vehicles_announce_themselves_by_time(speed: float, expected: float) -> None:
    assert announced_m(speed) == expected


@pytest.mark.parametrize(
    ("hold", "wait_s", "speed", "expected"),
    [
        (HOLD_SIGNAL, 0.0, 0.0, True),
        (HOLD_SIGNAL, 0.0, 0.6, False),
        (HOLD_EXIT_BLOCKED, 0.0, 0.5, True),
        (HOLD_YIELD, 60.0, 0.0, False),
        (HOLD_NONE, 3.0, 0.0, False),
        (HOLD_NONE, 3.1, 0.0, True),
        (HOLD_NONE, 3.1, 0.6, False),
    ],
)
def test_who_stands_and_does_not_want_to_go_is_let_stand(
    hold: int, wait_s: float, speed: float, expected: bool
) -> None:
    (row,) = vehicles([(0.0, 0.0, 0.0)], hold=hold, wait_s=wait_s, speed=speed)
    assert is_let_stand(row) == expected
