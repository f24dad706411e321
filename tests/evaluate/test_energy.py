"""Energy and CO₂ of agents and background vehicles in rewards, trips and episodes."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import TERMS, make_vec
from cavmarl.driving.vehicle_emissions import emissions_of
from cavmarl.evaluate.evaluation import evaluate

SMALL: dict[str, Any] = {"episodes": 2, "agents": 4, "background": 30, "max_cycles": 200}
NAMES = ("energy_wh_per_km", "co2_g_per_km")
WEIGHTS = {"terms.weights": {"energy": -0.1, "co2": -0.05}}


def test_energy_and_co2_have_the_size_of_real_cars_and_do_not_depend_on_zones() -> None:
    told = evaluate("grid4x4", "idm", seed=3, overrides=WEIGHTS, **SMALL)["idm"]
    for prefix in ("", "background_"):
        energy, co2 = (told[prefix + name].mean for name in NAMES)
        assert energy is not None
        assert co2 is not None
        assert 60.0 < energy < 400.0
        assert 120.0 < co2 < 700.0
    paid = (told["reward_energy"].mean or 0.0) + (told["reward_co2"].mean or 0.0)
    assert paid < 0.0
    assert paid == pytest.approx(told["episode_return"].mean, rel=1e-4)
    divided = evaluate("grid4x4", "idm", seed=3, overrides=WEIGHTS, zones=4, **SMALL)["idm"]
    for name in (*NAMES, *(f"background_{name}" for name in NAMES), "episode_return"):
        assert divided[name].mean == told[name].mean


def test_a_world_without_background_vehicles_has_no_background_energy() -> None:
    told = evaluate("grid4x4", "idm", seed=3, **{**SMALL, "background": 0, "max_cycles": 20})
    assert told["idm"]["background_energy_wh_per_km"].mean is None
    assert told["idm"]["energy_wh_per_km"].mean is not None


def rewards(**more: Any) -> NDArray[np.float32]:
    overrides = WEIGHTS | {"population.mode": "respawn"}
    with closing(make_vec("grid4x4", agents=4, background=30, overrides=overrides, **more)) as vec:
        _, infos = vec.reset(seed=5)
        found = []
        for _ in range(60):
            _, paid, *_, infos = vec.step(vec.suggest_actions())
            found.append(paid.copy())
            rows = vec.simulation.vehicles(0) if not more else np.zeros(0)
            for row in rows[rows["agent"] >= 0] if len(rows) else ():
                vclass = vec.simulation.types["vclass"][row["vtype"]]
                used = emissions_of(row.reshape(1), np.array([vclass]), vec.step_s)[0]
                terms = infos["terms"][0, row["agent"]]
                if infos["acted"][0, row["agent"]] and not infos["vehicle_done"][0, row["agent"]]:
                    expected = used.astype(np.float32).tolist()
                    assert terms[[TERMS.index("energy"), TERMS.index("co2")]].tolist() == expected
        return np.array(found)


def test_energy_rewards_are_equal_in_all_divisions() -> None:
    undivided = rewards()
    assert np.count_nonzero(undivided) > 100
    np.testing.assert_array_equal(rewards(zones=4), undivided)
    np.testing.assert_array_equal(rewards(zones=4, workers=2), undivided)
