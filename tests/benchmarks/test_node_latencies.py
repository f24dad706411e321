"""Costs of nodes: an empty tick, a killed node, and a city over several nodes."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest

from benchmarks import node_latencies, node_limit
from benchmarks.__main__ import programs
from benchmarks.world_processes import PER_JUNCTION, WorldProcess, make_city

pytestmark = pytest.mark.integration


def test_an_empty_tick_and_the_loss_of_a_node_are_measured() -> None:
    found = node_latencies.measure("ring", turns=1, kills=1)
    assert [(row["what"], row["unit"]) for row in found.rows] == [
        ("tick, wall", "us"),
        ("tick, processor", "us"),
        ("tick, least", "us"),
        ("zones stand still", "ms"),
    ]
    assert all(0.0 < row["least"] <= row["median"] <= row["most"] for row in found.rows)
    assert [row["times"] for row in found.rows] == [1, 1, 1, 1]


def test_a_city_half_of_it_and_two_halves_at_once_are_measured() -> None:
    least = PER_JUNCTION * 32
    found = node_limit.measure(vehicles=least, steps=1, repeats=1)
    assert [row["world"] for row in found.rows] == [
        f"{least:,} vehicles",
        f"{least // 2:,} vehicles",
        f"2 worlds of {least // 2:,} at once",
    ]
    assert found.rows[0]["faster"] == 1.0
    assert all(row["cpu_ms"] > 0.0 for row in found.rows)


def test_a_city_over_two_nodes_is_measured(tmp_path: Path) -> None:
    least = PER_JUNCTION * 16
    latency_s = 2e-3
    with closing(WorldProcess(make_city(tmp_path, least), least, 2, latency_s)) as city:
        turn = city.turn(steps=1)
    assert turn.latency_s > latency_s / 2.0
    assert turn.tick_s > 2.0 * latency_s  # a step of two ticks has at least five hops
    assert 0.0 < turn.node_s < turn.tick_s
    # `own` is of the slowest node, which may have fewer vehicles than the other node.
    assert 0.4 * least < turn.own < 0.6 * least
    assert turn.ghosts > 0
    assert turn.ticks_per_step == 2


def test_both_benchmarks_are_listed() -> None:
    assert {"node_latencies", "node_limit"} <= set(programs())
