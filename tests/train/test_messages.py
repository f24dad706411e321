"""The table of `train/messages.py`: both arms, and their difference by seed."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.training import TRAIN, load_program

pytest.importorskip("torch", reason="needs the extra: torch")


def test_the_arms_are_compared_by_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(TRAIN)
    program = load_program("messages")
    on = {"collision": [1.0, 2.0], "success": [90.0, 90.0], "delay_s": [5.0, 7.0]}
    off = {"collision": [3.0, 5.0], "success": [80.0, 70.0], "delay_s": [5.0, 8.0]}
    arms = {
        name: {key: np.array(values) for key, values in arm.items()}
        for name, arm in (("on", on), ("off", off))
    }
    (args,) = program.parse_args(["--config", "blind.yaml", "--env", "blind_junction"])
    lines = program.table(arms, args).splitlines()
    assert lines[-1].startswith("| on minus off | -2.50 [-8.85, 3.85] | 15.00 [")
    assert (
        lines[-2] == "| off | 4.00 [-8.71, 16.71] | 75.00 [11.47, 138.53] | 6.50 [-12.56, 25.56] |"
    )
    assert "| on | 1.50 [" in lines[-3]
