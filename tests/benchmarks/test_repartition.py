"""Zones that become others share out a crowd evenly; states stay the same."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.repartition import measure
from cavmarl.core.errors import ConfigError


def test_a_crowd_of_fifty_is_shared_out() -> None:
    settings = ["population.agents=50"]
    found = measure("rush", zones=4, every=10, steps=60, seeds=3, settings=settings)
    static, repartitioned = found.row("static"), found.row("repartitioned")
    assert found.facts["vehicles"] <= 50
    assert min(static["imbalance"]) > 2.0
    assert max(repartitioned["imbalance"]) < 0.75 * min(static["imbalance"])
    assert max(found.facts["ratios"]) < 0.75
    assert static["repartitions"] == 0 < repartitioned["repartitions"]
    assert repartitioned["repartition_ms"] > 0.0


@pytest.mark.parametrize("wrong", [{"zones": 1}, {"every": 0}, {"steps": 0}, {"seeds": 0}])
def test_measuring_nothing_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="must be at least"):
        measure("rush", **wrong)
