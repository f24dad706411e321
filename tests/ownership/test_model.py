"""The formal model and the scenarios have the same remedies, and the model is correct."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.ownership.scenarios import SCENARIOS

MODEL = Path(__file__).resolve().parents[2] / "docs/model"
REMEDY_OF = {
    "M_NOWAL": "log_before_send", "M_NOINC": "done_incarnation", "M_NOACKINC": "ack_incarnation",
    "M_NOFRESH": "ack_freshness", "M_NOABTFENCE": "abort_fence", "M_NOFLOOR": "fence_stays",
    "M_OVERWRITE": "replica_slot", "M_EARLYDROP": "copy_until_commit", "M_NOATTACH": "reattach",
    "M_NODEADLINE": "deadline", "M_NOSTEPCHK": "step_tick", "M_NODONESTEP": "done_tick",
    "M_SINGLEBUF": "double_buffer", "M_RESET": "tick_never_resets",
}  # fmt: skip


def test_each_mutation_of_the_model_removes_a_remedy_of_the_code() -> None:
    model = (MODEL / "handoff.pml").read_text()
    script = (MODEL / "check_model.sh").read_text()
    assert set(re.findall(r"\bM_[A-Z]+", model)) == set(REMEDY_OF)
    assert set(re.findall(r"\bM_[A-Z]+", script)) == set(REMEDY_OF)
    assert set(REMEDY_OF.values()) <= SCENARIOS.keys()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("spin") is None, reason="needs spin")
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_the_model_is_correct_and_every_mutation_is_detected() -> None:
    script = MODEL / "check_model.sh"
    done = subprocess.run(["sh", str(script)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert done.stdout.count("pass") == 8 + len(REMEDY_OF)
