"""`train/messages.py` compares training with and without messages, seed by seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.support.training import TRAIN, load_program

pytest.importorskip("torch", reason="needs the extra: train")


def test_the_table_has_differences_paired_by_seed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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
    assert "| off | 4.00 [" in lines[-2]
    assert lines[-2].endswith(" | 6.50 [-12.56, 25.56] |")  # not limited to 0 to 100
    assert "| on | 1.50 [" in lines[-3]


def test_intervals_of_shares_end_at_0_and_100(monkeypatch: pytest.MonkeyPatch) -> None:
    """Intervals of Student's t around 99.9 or 0.1 % would exceed these limits."""
    monkeypatch.syspath_prepend(TRAIN)
    found = load_program("messages").row(np.array([99.9, 99.8, 100.0]), percent=True).interval
    assert 99.0 < found.low < 99.9 < found.high <= 100.0
    five = load_program("five_seeds")
    low = five.interval_of(np.array([0.0, 0.003, 0.0]), True)
    assert 0.0 <= low.low < 0.001 < low.high < 0.05
    assert five.interval_of(np.array([0.0, 0.003, 0.0]), False).low < 0.0


def test_the_trainings_with_and_without_messages_get_the_given_settings(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(TRAIN)
    program = load_program("messages")
    trained: list[str] = []
    figures = {key: np.array([1.0]) for key in program.METRICS}
    monkeypatch.setattr(program, "train", lambda args: trained.append(args.settings) or {})
    monkeypatch.setattr(program, "drive", lambda *_: figures)
    monkeypatch.setattr(program, "draw", lambda *_: None)
    words = ["--config", "blind.yaml", "--env", "blind_junction", "--out", str(tmp_path)]
    program.compare(*program.parse_args([*words, "--settings", "population.background=4"]))
    program.compare(*program.parse_args(words))
    lost = ["v2x.channel.loss=0.0", "v2x.channel.loss=1.0"]
    assert trained == [*(f"population.background=4,{loss}" for loss in lost), *lost]
