"""The built-in driver waits for green even if the car's front is slightly over the line."""

from __future__ import annotations

import numpy as np

import cavmarl
from cavmarl.config.terms import TERMS
from cavmarl.core.records.codes import DRIVER_AGENT

RED_LIGHT, ARRIVAL = TERMS.index("red_light"), TERMS.index("arrival")
CREEP_MPS = 0.3
HALF_M = 2.5
OVER_M = 1.5


def test_a_car_that_has_crept_over_a_stop_line_waits_for_green() -> None:
    """The test lets cars that stand at a line creep on until the front is 1.5 m beyond the line."""
    vec = cavmarl.make_vec(
        "grid4x4",
        agents=12,
        background=0,
        overrides={"horizon_s": 600, "population.mode": "respawn"},
    )
    lengths = vec.network.lanes["length_m"]
    crept = red = arrived = 0
    try:
        vec.reset(seed=1)
        for _ in range(1500):
            actions = np.array(vec.suggest_actions())
            cars = vec.simulation.vehicles()
            cars = cars[cars["driver"] == DRIVER_AGENT]
            over_m = cars["s"] + HALF_M - lengths[cars["lane"]]
            stands = (cars["speed"] < CREEP_MPS) & (over_m > -4.0)
            stands &= actions[0, cars["agent"], 0] < 0.3
            creeps = cars["agent"][stands & (over_m < OVER_M)]
            actions[0, creeps, 0] = 0.3
            crept += int(np.count_nonzero(stands & (over_m >= OVER_M)))
            *_, infos = vec.step(actions)
            red += int(np.count_nonzero(infos["terms"][..., RED_LIGHT]))
            arrived += int(np.count_nonzero(infos["terms"][..., ARRIVAL]))
    finally:
        vec.close()
    assert crept > 0
    assert red == 0
    assert arrived > 12, "few cars went on at green"
