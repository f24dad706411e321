"""What each way to place shards would have taken, beside the static one, on the same traces.

The truth of the replay is a model: a worker gets the share of its processor that others leave, so
its shards take their cost over 1 - CPU, and memory and GPU in use slow nobody down. All workers
wait for the slowest. A shard that moves costs the rule's `move_s` once, a vehicle that is given to
another zone because the map is cut anew `HANDOFF_S`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.problem import BalanceRule
from cavmarl.bench.balance_strategies import (
    STRATEGIES,
    LoadStrategy,
    Placed,
    StaticPlacement,
)
from cavmarl.bench.load_traces import LoadTrace
from cavmarl.core.errors import ConfigError
from cavmarl.evaluate.statistics import Interval, mean_interval

__all__ = ["BalanceReplay", "StrategyResult", "Verdict", "replay_traces"]

HANDOFF_S = 1e-4
WARM_SHARE = 0.25  # of the rounds, before what is learnt is used and times count


Verdict = Literal[
    "less than static",
    "more than static",
    "within noise of static",
    "one trace tells nothing",
]


@dataclass(frozen=True)
class StrategyResult:
    """One way to place shards; means over traces.

    Attributes:
        name: of `STRATEGIES`, or `perfect`: as if shards could be divided at will.
        ratio: its time over that of the static placement.
        ratio95: between traces; None: of one trace.
        beside_balanced: its time over that of `balanced`.
        beside_balanced95: the same.
        imbalance: maximum over mean of the workers' ticks, mean over rounds.
        moves: shards a round.
        handoffs: vehicles a round that the cutting moved.
        weights: of the last round's score, mean.
        verdict: `ratio95` beside 1.
    """

    name: str
    ratio: float
    ratio95: Interval | None
    beside_balanced: float
    beside_balanced95: Interval | None
    imbalance: float
    moves: float
    handoffs: float
    weights: tuple[float, float, float]
    verdict: Verdict


@dataclass(frozen=True)
class BalanceReplay:
    """Result of `replay_traces`.

    Attributes:
        map_name: the map's name.
        zones: k.
        workers: m.
        traces: how many.
        rounds: of each, those before times count among them.
        ticks: of a round.
        rule: when shards move, and what that costs.
        rows: by strategy.
    """

    map_name: str
    zones: int
    workers: int
    traces: int
    rounds: int
    ticks: int
    rule: BalanceRule
    rows: tuple[StrategyResult, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class _Totals:
    """One strategy on one trace, from the first round that counts."""

    time_s: float
    imbalance: float
    moves: float
    handoffs: float
    weights: tuple[float, float, float]


def replay_traces(traces: Sequence[LoadTrace], rule: BalanceRule) -> BalanceReplay:
    """Replay every trace through every strategy.

    Args:
        traces: of the same map, zones, workers and number of rounds.
        rule: when shards move.

    Raises:
        ConfigError: no trace, or too few rounds to learn from; more workers than zones.
        NoAdmissibleWorkerError: at the first plan all workers are excluded.
    """
    if not traces:
        raise ConfigError("traces: there must be at least one")
    first = traces[0]
    rounds = len(first.rounds)
    warm = math.ceil(WARM_SHARE * rounds)
    if rounds < 4:
        raise ConfigError(f"rounds = {rounds}: must be at least 4, of which the first are learnt")
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
        recut=name == "re-cut",
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
    """How long a tick takes, and would if shards could be divided at will."""
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
    interval = mean_interval(ratios)
    cpu, ram, gpu = np.mean([one.weights for one in found], axis=0).tolist()
    return StrategyResult(
        name=name,
        ratio=float(ratios.mean()),
        ratio95=interval,
        beside_balanced=float(beside.mean()),
        beside_balanced95=mean_interval(beside),
        imbalance=float(np.mean([one.imbalance for one in found])),
        moves=float(np.mean([one.moves for one in found])),
        handoffs=float(np.mean([one.handoffs for one in found])),
        weights=(cpu, ram, gpu),
        verdict=_verdict(interval),
    )


def _verdict(interval: Interval | None) -> Verdict:
    if interval is None:
        return "one trace tells nothing"
    if interval.high < 1.0:
        return "less than static"
    return "more than static" if interval.low > 1.0 else "within noise of static"
