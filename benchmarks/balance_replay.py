"""Replay of load traces through each placement strategy, compared with static placement.

The replay computes the time of each tick from the recorded costs and loads, with a simple model. A
worker gets the share of its processor that other programs leave, so its shards take their cost /
(1 - CPU). Used memory and a used GPU do not slow a worker down. All workers wait for the slowest
worker. A moved shard costs the rule's `move_s` once, and a vehicle that changes its zone because
the map is cut again costs `HANDOFF_S`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.balance_strategies import STRATEGIES, LoadStrategy, Placed, StaticPlacement
from benchmarks.load_traces import LoadTrace
from cavmarl.balance.problem import BalanceRule
from cavmarl.core.errors import ConfigError
from cavmarl.evaluate.statistics import Interval, mean_interval

__all__ = ["BalanceReplay", "StrategyResult", "Verdict", "replay_traces"]

HANDOFF_S = 1e-4
WARM_SHARE = 0.25  # share of rounds for learning; only times of later rounds count


Verdict = Literal[
    "less than static",
    "more than static",
    "within noise of static",
    "one trace tells nothing",
]


@dataclass(frozen=True)
class StrategyResult:
    """The results of one placement strategy; all values are means over traces."""

    name: str  # name in `STRATEGIES`, or `perfect` for arbitrarily divisible shards
    ratio: float  # time / time of the static placement
    ratio95: Interval | None  # 95 % interval between traces; None: a single trace
    beside_balanced: float  # time / time of `balanced`
    beside_balanced95: Interval | None  # 95 % interval between traces; None: a single trace
    imbalance: float  # maximum / mean of the workers' ticks, mean over rounds
    moves: float  # moved shards per round
    handoffs: float  # vehicles per round that changed their zone because of a new cut
    weights: tuple[float, float, float]  # weights of the last round's score, mean
    verdict: Verdict  # derived from `ratio95`


@dataclass(frozen=True)
class BalanceReplay:
    """Result of `replay_traces`."""

    map_name: str  # name of the map
    zones: int  # number of zones
    workers: int  # number of workers
    traces: int  # number of traces
    rounds: int  # rounds per trace, including rounds for learning
    ticks: int  # ticks per round
    rule: BalanceRule  # conditions for moving shards, and the cost of a move
    rows: tuple[StrategyResult, ...]  # results by strategy


@dataclass(frozen=True)
class _Totals:
    """Sums of one strategy on one trace, without the rounds for learning."""

    time_s: float
    imbalance: float
    moves: float
    handoffs: float
    weights: tuple[float, float, float]


def replay_traces(traces: Sequence[LoadTrace], rule: BalanceRule) -> BalanceReplay:
    """Replay every trace through every strategy."""
    if not traces:
        raise ConfigError("traces: at least one is needed")
    first = traces[0]
    rounds = len(first.rounds)
    warm = math.ceil(WARM_SHARE * rounds)
    if rounds < 4:
        raise ConfigError(
            f"rounds = {rounds}: must be at least 4; the first rounds are for learning"
        )
    totals = {name: [_replay(name, one, rule, warm) for one in traces]
              for name in (*STRATEGIES, "perfect")}  # fmt: skip
    static, balanced = (
        np.array([one.time_s for one in totals[name]]) for name in ("static", "balanced")
    )
    return BalanceReplay(
        map_name=first.network.name,
        zones=first.partition.count,
        workers=len(first.rounds[0].snapshot.workers),
        traces=len(traces),
        rounds=rounds,
        ticks=first.ticks,
        rule=rule,
        rows=tuple(_summary(name, found, static, balanced) for name, found in totals.items()),
    )


def _strategy(name: str, trace: LoadTrace, rule: BalanceRule, warm: int) -> StaticPlacement:
    if name in ("static", "perfect"):
        return StaticPlacement(trace, rule)
    return LoadStrategy(
        trace,
        rule,
        warm,
        calibrated=name == "calibrated",
        predicted=name == "predicted",
        repartitioned=name == "repartitioned",
    )


def _replay(name: str, trace: LoadTrace, rule: BalanceRule, warm: int) -> _Totals:
    strategy = _strategy(name, trace, rule, warm)
    found = []
    for number in range(len(trace.rounds)):
        placed = strategy.place(number)
        slowest_s, fair_s = _tick_s(trace, number, placed)
        if name == "perfect":
            slowest_s = fair_s
        time_s = trace.ticks * slowest_s
        time_s += rule.move_s * placed.moved_shards + HANDOFF_S * placed.moved_vehicles
        imbalance = slowest_s / fair_s if fair_s else 1.0
        found.append((time_s, imbalance, placed.moved_shards, placed.moved_vehicles))
        strategy.learn(number)
    times, imbalances, moves, handoffs = np.array(found[warm:]).T
    return _Totals(
        float(times.sum()),
        float(imbalances.mean()),
        float(moves.mean()),
        float(handoffs.mean()),
        strategy.balancer.plan.problem.rule.load.weights,
    )


def _tick_s(trace: LoadTrace, number: int, placed: Placed) -> tuple[float, float]:
    """Return the time of a tick, and the time with arbitrarily divisible shards."""
    costs_s = trace.costs_s(number, placed.partition)
    workers = trace.rounds[number].snapshot.workers
    speeds = np.array([1.0 - candidate.use.cpu for candidate in workers])
    place = {candidate.worker: n for n, candidate in enumerate(workers)}
    loads_s = np.bincount([place[home] for home in placed.homes], costs_s, len(workers))
    return float((loads_s / speeds).max()), float(costs_s.sum() / speeds.sum())


def _summary(
    name: str,
    found: Sequence[_Totals],
    static: NDArray[np.float64],
    balanced: NDArray[np.float64],
) -> StrategyResult:
    times = np.array([one.time_s for one in found])
    ratios, beside = times / static, times / balanced
    cpu, ram, gpu = np.mean([one.weights for one in found], axis=0).tolist()
    return StrategyResult(
        name=name,
        ratio=float(ratios.mean()),
        ratio95=mean_interval(ratios),
        beside_balanced=float(beside.mean()),
        beside_balanced95=mean_interval(beside),
        imbalance=float(np.mean([one.imbalance for one in found])),
        moves=float(np.mean([one.moves for one in found])),
        handoffs=float(np.mean([one.handoffs for one in found])),
        weights=(cpu, ram, gpu),
        verdict=_verdict(ratios),
    )


def _verdict(ratios: NDArray[np.float64]) -> Verdict:
    if len(ratios) < 2:
        return "one trace tells nothing"
    low = high = float(ratios.mean())  # there is no interval if all ratios are equal
    if (interval := mean_interval(ratios)) is not None:
        low, high = interval.low, interval.high
    if high < 1.0:
        return "less than static"
    return "more than static" if low > 1.0 else "within noise of static"
