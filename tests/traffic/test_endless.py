"""`traffic.endless`: agents that arrive get another goal, which does not reduce their reward."""

from __future__ import annotations

import cavmarl
from cavmarl.config.terms import TERMS

PROGRESS = TERMS.index("progress")


def drive(endless: bool) -> tuple[float, bool]:
    """Return how far a single car drives on a ring of 260 m in 90 s, and whether its trip ended."""
    overrides = {"traffic.endless": endless, "traffic.demand": []}
    vec = cavmarl.make_vec("ring22", overrides=overrides)
    vec.reset(seed=2)
    way_m, ended = 0.0, False
    for _ in range(449):
        _, _, terminated, _, _ = vec.step(vec.suggest_actions())
        progress_m = float(vec.worlds.arrays.terms[0, 0, PROGRESS])
        assert progress_m > -0.1  # a new goal causes no negative progress
        way_m += progress_m
        ended |= bool(terminated.any())
    return way_m, ended


def test_an_endless_trip_does_not_end() -> None:
    way_m, ended = drive(endless=True)
    assert not ended
    assert way_m > 2 * 260.0  # over two rounds
    assert drive(endless=False)[1]


def test_zones_change_no_result() -> None:
    def seen(zones: int) -> list[bytes]:
        overrides = {"traffic.endless": True}
        vec = cavmarl.make_vec("ring", agents=3, background=6, zones=zones, overrides=overrides)
        vec.reset(seed=2)
        return [vec.step(vec.suggest_actions())[0].tobytes() for _ in range(200)]

    assert seen(1) == seen(2)
