"""Replays of load traces whose results are known, and recorded traces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.balance import generated_traces, measure, recorded_traces
from benchmarks.balance_replay import BalanceReplay, StrategyResult, replay_traces
from benchmarks.balance_strategies import STRATEGIES
from benchmarks.load_traces import Crowd, LoadRound, LoadTrace, generated_trace
from cavmarl.balance.load_score import Candidate, Utilisation
from cavmarl.balance.load_snapshot import LoadSnapshot, idle_snapshot
from cavmarl.balance.problem import BalanceRule
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import find_map
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_layouts import cut_map

FREE = BalanceRule(move_s=0.0)


@pytest.fixture(scope="module")
def network() -> RoadNetwork:
    return load_network(find_map("grid4x4"))


def constant_trace(
    network: RoadNetwork, counts: list[int], snapshot: LoadSnapshot, rounds: int = 8
) -> LoadTrace:
    """Return a trace in which zone k always has counts[k] vehicles, which cost 1 µs each."""
    partition = cut_map(network, "grid", len(counts))
    middles = 0.5 * (partition.rects[:, :2] + partition.rects[:, 2:])
    places = np.repeat(middles, counts, axis=0)
    one = LoadRound(
        ids=np.arange(len(places)),
        places=places,
        agents=np.zeros(len(places), dtype=bool),
        vehicle_s=np.full(len(places), 1e-6),
        noise=np.ones(len(counts)),
        snapshot=snapshot,
    )
    return LoadTrace(network, partition, 200, 0.0, (one,) * rounds)


def row_of(found: BalanceReplay, name: str) -> StrategyResult:
    (row,) = (row for row in found.rows if row.name == name)
    return row


def test_balanced_placements_of_constant_loads_reach_the_perfect_time(
    network: RoadNetwork,
) -> None:
    found = replay_traces([constant_trace(network, [30, 30, 10, 10], idle_snapshot(2))], FREE)
    assert [row.name for row in found.rows] == [*STRATEGIES, "perfect"]
    # The static placement puts zones in their order on two workers, with 60 and 20 vehicles. The
    # perfect placement has 40 and 40.
    assert row_of(found, "static").imbalance == pytest.approx(1.5)
    for name in ("balanced", "predicted", "perfect"):
        assert row_of(found, name).ratio == pytest.approx(40.0 / 60.0)
    assert row_of(found, "balanced").ratio95 is None
    assert row_of(found, "balanced").verdict == "one trace tells nothing"


def test_no_zone_moves_if_no_move_has_a_gain(network: RoadNetwork) -> None:
    trace = constant_trace(network, [20, 20, 20, 20], idle_snapshot(2))
    found = replay_traces([trace, trace], BalanceRule())
    for row in found.rows:
        assert (row.ratio, row.imbalance, row.moves) == pytest.approx((1.0, 1.0, 0.0))
    assert row_of(found, "balanced").verdict == "within noise of static"


def test_no_zone_moves_if_the_move_costs_more_than_its_gain(network: RoadNetwork) -> None:
    trace = constant_trace(network, [30, 30, 10, 10], idle_snapshot(2))
    dear = replay_traces([trace], BalanceRule(move_s=1e3))
    assert row_of(dear, "balanced").ratio == 1.0
    assert row_of(dear, "balanced").moves == 0.0


def test_a_large_zone_is_divided_if_moving_zones_does_not_help(network: RoadNetwork) -> None:
    trace = constant_trace(network, [4, 4, 4, 400], idle_snapshot(4), rounds=24)
    places = trace.rounds[0].places.copy()
    low, high = trace.partition.rects[3][:2], trace.partition.rects[3][2:]
    places[12:] = np.random.default_rng(0).uniform(low + 1.0, high - 1.0, (400, 2))
    spread = replace(trace, rounds=(replace(trace.rounds[0], places=places),) * 24)
    found = replay_traces([spread], FREE)
    assert row_of(found, "balanced").ratio == 1.0
    assert row_of(found, "repartitioned").ratio < 0.6
    assert row_of(found, "repartitioned").handoffs > 0.0


def test_calibration_gives_all_weight_to_the_resource_that_slows_workers(
    network: RoadNetwork,
) -> None:
    uses = [Utilisation(0.8, 0.1, 0.1), Utilisation(0.1, 0.8, 0.1), Utilisation(0.1, 0.1, 0.9)]
    workers = tuple(Candidate(n, use) for n, use in enumerate(uses))
    trace = constant_trace(
        network, [20] * 9, LoadSnapshot(workers, "simulated", "generated"), rounds=12
    )
    found = replay_traces([trace], FREE)
    assert row_of(found, "calibrated").weights == pytest.approx((1.0, 0.0, 0.0), abs=1e-9)
    assert row_of(found, "balanced").weights == (0.6, 0.2, 0.2)
    assert row_of(found, "calibrated").ratio < row_of(found, "balanced").ratio


def test_equal_seeds_generate_equal_traces(network: RoadNetwork) -> None:
    partition = cut_map(network, "bisection", 4)

    def trace(seed: int) -> LoadTrace:
        return generated_trace(network, partition, rounds=5, workers=2, seed=seed)

    one, same, other = trace(1), trace(1), trace(2)
    for first, second in zip(one.rounds, same.rounds, strict=True):
        assert np.array_equal(first.places, second.places)
        assert first.snapshot == second.snapshot
    assert not np.array_equal(one.rounds[0].places, other.rounds[0].places)
    assert one.rounds[0].snapshot.gpu_source == "simulated"


def test_the_cost_of_a_zone_is_the_sum_of_the_costs_of_its_vehicles(network: RoadNetwork) -> None:
    crowd = Crowd(vehicles=50, vehicle_s=1.0, agent_s=10.0, migration_s=0.0, noise=0.0)
    partition = cut_map(network, "bisection", 3)
    trace = generated_trace(network, partition, rounds=3, workers=2, seed=0, crowd=crowd)
    contents = trace.contents(2, partition)
    assert sum(content.vehicles for content in contents) == 50.0
    for cost_s, content in zip(trace.costs_s(2, partition), contents, strict=True):
        assert cost_s == pytest.approx(content.vehicles + 10.0 * content.readings)
    assert trace.measured_s(2, partition) == pytest.approx(trace.costs_s(2, partition))
    came = [content.migrations for content in trace.contents(1, partition)]
    before = partition.zones_of(trace.rounds[0].places)
    after = partition.zones_of(trace.rounds[1].places)
    assert came == [
        float(((before != after) & (after == zone)).sum()) for zone in range(partition.count)
    ]


def test_traces_of_an_environment_can_be_recorded_and_replayed() -> None:
    traces = list(
        recorded_traces(
            "ring",
            zones=2,
            layout="strips",
            workers=2,
            rounds=4,
            seeds=[0, 1],
            overrides={"population.agents": 2, "population.background": 10},
        )
    )
    assert len(traces) == 2
    for trace in traces:
        assert len(trace.rounds) == 4
        for number, one in enumerate(trace.rounds):
            contents = trace.contents(number, trace.partition)
            assert sum(content.vehicles for content in contents) == len(one.ids) > 0
            assert sum(content.readings for content in contents) == one.agents.sum()
            assert trace.costs_s(number, trace.partition).sum() > 0.0
    found = replay_traces(traces, FREE)
    assert all(row.ratio > 0.0 for row in found.rows)


def test_recordings_that_cannot_be_replayed_are_refused(network: RoadNetwork) -> None:
    with pytest.raises(ConfigError, match="at least one"):
        replay_traces([], FREE)
    with pytest.raises(ConfigError, match="rounds = 3"):
        replay_traces([constant_trace(network, [1, 1], idle_snapshot(2), rounds=3)], FREE)
    with pytest.raises(ConfigError, match="3 workers for 2 shards"):
        replay_traces([constant_trace(network, [1, 1], idle_snapshot(3))], FREE)
    crowd = {"layout": "bisection", "workers": 2, "rounds": 4, "seeds": [0], "overrides": {}}
    with pytest.raises(ConfigError):
        list(generated_traces("ring", zones=1000, **crowd))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="no settings"):
        list(generated_traces("ring", zones=2, **crowd | {"overrides": {"a": 1}}))  # type: ignore[arg-type]


def test_the_report_names_every_placement() -> None:
    found = measure("grid4x4", zones=4, workers=2, traces=2, rounds=8)
    assert [row["name"] for row in found.rows] == [*STRATEGIES, "perfect"]
    assert found.facts["recorded"] is False
