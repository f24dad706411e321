"""The cost model of nodes finds the parameters from which its samples were generated."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from benchmarks import node_costs
from benchmarks import nodes as benchmark
from benchmarks.node_costs import Caches, NodeCosts, NodeSample, borders, caches_here, fitted
from cavmarl.core.errors import ConfigError

KNOWN = NodeCosts(
    tick_s=2e-4,
    ghost_s=5e-7,
    whole_s=5e-5,
    vehicle_s=3e-7,
    far_s=4e-7,
    memory_s=5e-7,
    caches=Caches(own=4_000.0, shared=12_000.0, cores=64),
    caller_s=8e-5,
    caller_node_s=4e-5,
    wake_s=3e-5,
    uneven=0.05,
    base_bytes=2e8,
    city_bytes=1e3,
    own_bytes=2e3,
    ghost_factor=4.0,
    crossing_share=1e-3,
    ticks_per_step=2.0,
)


def sample(vehicles: int, nodes: int, latency_s: float = 0.0) -> NodeSample:
    own, ghosts = vehicles / max(nodes, 1), KNOWN.ghosts(vehicles, nodes) if nodes else 0.0
    node_s = KNOWN.tick_s + KNOWN.ghost_s * ghosts if nodes else KNOWN.whole_s
    return NodeSample(
        vehicles=vehicles,
        nodes=nodes,
        tick_s=KNOWN.tick(vehicles, nodes, latency_s, cores=64),
        node_s=node_s + KNOWN.work(own, ghosts, nodes),
        caller_s=KNOWN.caller_s + KNOWN.caller_node_s * nodes if nodes else 0.0,
        own=own,
        ghosts=ghosts,
        crossings=KNOWN.crossing_share * ghosts * nodes,
        memory_bytes=KNOWN.memory(vehicles, nodes),
        latency_s=latency_s,
        ticks_per_step=KNOWN.ticks_per_step,
    )


def test_the_parameters_of_generated_samples_are_found() -> None:
    samples = [sample(size, nodes) for size in (1_000, 5_000, 20_000) for nodes in (0, 1, 2)]
    costs = fitted(samples, KNOWN.caches)
    found, known = ({**asdict(one), "caches": 0.0} for one in (costs, KNOWN))
    assert found == pytest.approx(known, rel=1e-6)
    assert costs.tick(10**6, 16, 1e-3, 64) == pytest.approx(KNOWN.tick(10**6, 16, 1e-3, 64))


def test_negative_estimates_become_zero() -> None:
    samples = [sample(size, nodes) for size in (1_000, 5_000, 20_000) for nodes in (0, 1, 2)]
    cheap = [replace(s, caller_s=1e-4 / max(s.nodes, 1)) for s in samples]
    assert fitted(cheap, KNOWN.caches).caller_node_s == 0.0


def test_the_cost_of_latency_is_proportional_to_the_hops_of_a_step() -> None:
    """A step of two ticks has five hops: a command, three exchanges and a report."""
    for vehicles, offers in ((100, 0.0), (10**10, 1.0)):
        near, far = (KNOWN.tick(vehicles, 4, latency_s, 64) for latency_s in (0.0, 1e-3))
        assert far - near == pytest.approx(1e-3 * (5.0 + offers) / 2.0, rel=0.05)
    alone = KNOWN.tick(5_000, 1, 1e-3, 64) - KNOWN.tick(5_000, 1, 0.0, 64)
    assert alone == pytest.approx(1e-3)


def test_rows_beyond_the_capacity_of_caches_cost_more() -> None:
    def work(vehicles: float, ghosts: float = 0.0, busy: int = 1) -> float:
        return KNOWN.work(vehicles, ghosts, busy)

    assert work(4_000) == pytest.approx(4_000 * 3e-7)
    assert work(10_000) - work(9_000) == pytest.approx(1_000 * 7e-7)
    assert work(4_000, ghosts=100) - work(4_000) == pytest.approx(100 * 4e-7)
    assert work(14_000) - work(13_000) == pytest.approx(1_000 * 12e-7)
    assert work(10_000, busy=2) - work(10_000) == pytest.approx(4_000 * 5e-7)


def test_the_capacity_of_caches_in_rows_is_read_from_the_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(node_costs, "CACHES", tmp_path)
    row = node_costs.ROW_BYTES
    assert caches_here()[:2] == ((1 << 20) / row, (32 << 20) / row)
    for level, size in (("index2", "512K\n"), ("index3", "16384K\n")):
        (tmp_path / level).mkdir()
        (tmp_path / level / "size").write_text(size, encoding="ascii")
    assert caches_here()[:2] == ((1 << 19) / row, (16 << 20) / row)


def test_a_tick_takes_longer_if_there_are_more_nodes_than_cores() -> None:
    assert KNOWN.tick(10**6, 4, 0.0, 2) > 1.5 * KNOWN.tick(10**6, 4, 0.0, 4)


@pytest.mark.parametrize("side", [2, 3, 4])
def test_the_mean_number_of_borders_of_a_zone_in_a_square_is_exact(side: int) -> None:
    inner = 2 * side * (side - 1)
    assert borders(side * side) == pytest.approx(2 * inner / side**2)
    assert borders(1) == 0.0
    assert KNOWN.ghosts(4e4, side * side) == pytest.approx(
        KNOWN.ghost_factor * borders(side * side) * math.sqrt(4e4) / side
    )


def test_too_few_samples_are_refused() -> None:
    with pytest.raises(ValueError, match="undivided runs of two sizes"):
        fitted([sample(1_000, nodes) for nodes in (0, 1, 2)], KNOWN.caches)


@pytest.mark.parametrize(
    ("vehicles", "nodes"),
    [("2500", "1,2"), ("2500,2500", "1,2"), ("100,2500", "1,2"), ("2500,9000", "2")],
)
def test_too_few_requested_runs_are_refused_before_the_first_run(vehicles: str, nodes: str) -> None:
    with pytest.raises(ConfigError, match="two sizes of at least 400, and the nodes 1 and 2"):
        benchmark.measure(vehicles, nodes)
