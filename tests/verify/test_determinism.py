"""Runs in three processes are compared, and the first difference is reported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cavmarl.core.errors import ConfigError, EvaluationError, PolicyError
from cavmarl.verify.determinism import verify_determinism

# A driver whose action for one agent in one step depends on the hash seed of the process.
HASHING = """
from cavmarl.policies.policy import Policy

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


def test_the_built_in_driver_gives_the_same_run_in_every_process() -> None:
    found = verify_determinism("merge", "idm", steps=20, **SMALL)
    assert found.difference is None
    assert (found.steps, found.ticks) == (20, 20 * TICKS_PER_STEP)
    other = verify_determinism("merge", "idm", steps=20, seed=1, **SMALL)
    assert found.state_hash != other.state_hash


def test_a_driver_that_depends_on_hashes_is_detected(tmp_path: Path) -> None:
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
