"""What nodes cost beside the kernels: an empty tick, a killed node, and what the machine allows."""

from __future__ import annotations

import pytest

from benchmarks import node_latencies, node_limit
from benchmarks.__main__ import programs
from benchmarks.nodes import PER_JUNCTION
from cavmarl.core.errors import ConfigError


def test_an_empty_tick_and_a_killed_node_are_timed() -> None:
    found = node_latencies.measure("ring", turns=1, kills=1)
    assert [(row["what"], row["unit"]) for row in found.rows] == [
        ("tick, wall", "us"),
        ("tick, processor", "us"),
        ("tick, least", "us"),
        ("zones stand still", "ms"),
    ]
    assert all(0.0 < row["least"] <= row["median"] <= row["most"] for row in found.rows)
    assert [row["times"] for row in found.rows] == [1, 1, 1, 1]


def test_one_node_alone_is_refused() -> None:
    with pytest.raises(ConfigError, match="--nodes 1: of fewer than two"):
        node_latencies.measure("ring", nodes=1)


def test_two_halves_run_beside_one_another() -> None:
    least = PER_JUNCTION * 32
    found = node_limit.measure(vehicles=least, steps=1, repeats=1)
    assert [row["world"] for row in found.rows] == [
        f"{least:,} vehicles",
        f"{least // 2:,} vehicles",
        f"twice {least // 2:,} at once",
    ]
    assert found.rows[0]["faster"] == 1.0
    assert all(row["cpu_ms"] > 0.0 for row in found.rows)
    with pytest.raises(ConfigError, match="--vehicles 1: at least"):
        node_limit.measure(vehicles=1)


def test_both_are_listed() -> None:
    assert {"node_latencies", "node_limit"} <= set(programs())
