"""`traffic.endless`: agents drive on to another goal, and are not charged for it."""

from __future__ import annotations

import numpy as np

import cavmarl
from cavmarl.config.env import TERMS

PROGRESS, ARRIVAL = TERMS.index("progress"), TERMS.index("arrival")


def drive(steps: int, endless: bool = True, **keywords: object) -> tuple[list[bytes], float, bool]:
    vec = cavmarl.make_vec(
        "ring", agents=3, background=6, overrides={"traffic.endless": endless}, **keywords
    )
    vec.reset(seed=2)
    seen, way_m, ended = [], 0.0, False
    for _ in range(steps):
        observations, _, terminated, _, _ = vec.step(vec.suggest_actions())
        terms = vec.worlds.arrays.terms[0, :, PROGRESS]
        way_m += float(terms.sum())
        assert np.all(terms > -1.0)  # another goal is no way back
        ended |= bool(terminated.any())
        seen.append(observations.tobytes())
    return seen, way_m, ended


def test_no_agent_arrives_where_trips_are_endless() -> None:
    _, way_m, ended = drive(500)
    assert not ended
    assert way_m > 3 * 400.0  # each has driven round
    assert drive(500, endless=False)[2]


def test_zones_change_nothing() -> None:
    assert drive(200)[0] == drive(200, zones=2)[0]
