"""Three processes agree, and where they do not, the first difference is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.errors import ConfigError, EvaluationError, PolicyError
from cavmarl.evaluate.determinism import _first_difference, verify_determinism
from cavmarl.shard.vehicles import VEHICLE

# A driver whose actions depend on the order of a process's own hashes, in one step, for one agent.
HASHING = """
from cavmarl.policies import Policy

class Hashing(Policy):
    step = 0

    def act_batch(self, observations, mask):
        actions = self.env.suggest_actions()
        self.step += 1
        if self.step == 7:
            actions[0, 1, 0] = -hash("car_1") % 997 / 1000.0
        return actions

def make_policy(env):
    return Hashing(env)
"""
TICKS_PER_STEP = 2
SMALL: dict[str, Any] = {
    "agents": 3,
    "background": 3,
    "overrides": {"clock.sim_dt_s": 0.05, "clock.ctrl_dt_s": 0.05 * TICKS_PER_STEP},
}


def test_the_built_in_driver_is_the_same_in_every_process() -> None:
    found = verify_determinism("merge", "idm", steps=20, **SMALL)
    assert found.difference is None
    assert (found.steps, found.ticks) == (20, 20 * TICKS_PER_STEP)
    other = verify_determinism("merge", "idm", steps=20, seed=1, **SMALL)
    assert found.state_hash != other.state_hash


def test_a_driver_that_hashes_is_found_out(tmp_path: Path) -> None:
    script = tmp_path / "hashing.py"
    script.write_text(HASHING)
    found = verify_determinism("merge", script, steps=20, **SMALL)
    difference = found.difference
    assert difference is not None
    assert (difference.step, difference.tick) == (7, 7 * TICKS_PER_STEP)
    assert (difference.what, difference.vehicle) == ("vehicle", 1)
    assert difference.field == "s"
    assert difference.values[0] != difference.values[1]
    assert difference.processes[0] == 0


def test_bad_input_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="steps = 0"):
        verify_determinism("merge", steps=0)
    with pytest.raises(PolicyError, match="idn"):
        verify_determinism("merge", "idn", steps=1)


def test_a_process_that_dies_is_reported(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    script = tmp_path / "dying.py"
    script.write_text("import os\n\ndef make_policy(env):\n    os._exit(3)\n")
    with pytest.raises(EvaluationError, match="exit code 3"):
        verify_determinism("merge", script, steps=1)


def state(**fields: object) -> dict[str, np.ndarray]:
    vehicles = np.zeros(2, VEHICLE)
    vehicles["id"] = [4, 9]
    for name, values in fields.items():
        vehicles[name] = values
    return {"vehicles": vehicles, "rewards": np.zeros((1, 2), np.float32)}


def test_the_smallest_id_and_the_first_field_come_first() -> None:
    one, other = state(), state(speed=[2.0, 1.0], x=[0.0, 3.0])
    found = _first_difference(5, 10, (0, 2), [one, other])
    assert (found.vehicle, found.field, found.values) == (4, "speed", (0.0, 2.0))
    assert (found.step, found.tick, found.processes) == (5, 10, (0, 2))


def test_a_vehicle_that_only_one_has_is_named() -> None:
    other = state()
    other["vehicles"] = other["vehicles"][1:]
    found = _first_difference(5, 10, (0, 1), [state(), other])
    assert (found.vehicle, found.field, found.values) == (4, "id", (4, None))


def test_signs_of_zero_are_a_difference_and_nan_is_none() -> None:
    same = _first_difference(1, 2, (0, 1), [state(accel=np.nan), state(accel=np.nan)])
    assert same.what == "hidden state"
    other = state()
    other["rewards"][0, 1] = -0.0
    found = _first_difference(1, 2, (0, 1), [state(), other])
    assert (found.what, found.vehicle, found.field) == ("rewards", None, "[0, 1]")
