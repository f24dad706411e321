"""Metrics of V2X messages in evaluations."""

from __future__ import annotations

from typing import Any

import pytest

from cavmarl.evaluate.evaluation import evaluate

LOSSY = {"v2x.enabled": True, "v2x.channel.loss": 0.25, "v2x.channel.latency_ticks": 2}


def test_an_episode_has_its_reception_ratio_and_latency() -> None:
    small: dict[str, Any] = {"episodes": 2, "agents": 3, "background": 12, "max_cycles": 30}
    told = evaluate("grid4x4", "idm", overrides=LOSSY, **small)
    found = told["idm"]
    assert found["v2x_reception_ratio"].mean == pytest.approx(0.75, abs=0.02)
    assert found["v2x_latency_s"].mean == pytest.approx(0.1)
    assert told.manifest["world"]["channel"]["loss"] == 0.25
    assert told.manifest["world"]["channel"]["latency_ticks"] == 2
    without = evaluate("grid4x4", "idm", **small)
    assert without.manifest["world"]["channel"].startswith("none: there are no messages")
    silent = without["idm"]
    assert silent["v2x_reception_ratio"].mean is None
    assert silent["v2x_busy_ratio"].mean is None
