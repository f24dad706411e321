"""Statistics of transfers: their number, their results and their durations."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from cavmarl.ownership.transfers import Transfer


class Spread(NamedTuple):
    """Nearest-rank percentiles; all are None if there are no values."""

    p50: float | None
    p95: float | None
    max: float | None

    @classmethod
    def of(cls, values: Iterable[float]) -> Spread:
        ordered = sorted(values)
        if not ordered:
            return cls(None, None, None)
        last = len(ordered)
        return cls(
            ordered[math.ceil(0.50 * last) - 1], ordered[math.ceil(0.95 * last) - 1], ordered[-1]
        )


@dataclass(frozen=True)
class TransferSummary:
    """Statistics of transfers, and of approaches without a transfer."""

    transfers: int  # number of changes of owner
    forced: int  # transfers with the state attached, because no acknowledgement arrived in time
    removed: int  # transfers of vehicles that left the world in the same tick
    deferred: int  # ticks that vehicles stayed with the old owner after crossing, summed
    refused: int  # states that a target refused
    aborted: int  # approaches that ended without a transfer
    # phase → number of timeouts. `acknowledge`: no answer by the end of the tick (same number as
    # `deferred`); `switch`: no answer by the deadline (same number as `forced`); `replica`: states
    # that were neither used nor withdrawn in their lifetime
    timeouts: Mapping[str, int]
    latency_ticks: Spread  # ticks from the first state at the target to its confirmation
    waited_ticks: Spread  # the part of `latency_ticks` after the crossing
    latency_ms: Spread  # same duration as `latency_ticks`, in ms of real time
    state_bytes: Spread  # size of a vehicle's state
    # distance outside of the owner's zone when the target got the first state; negative: inside
    prepare_depth_m: Spread
    switch_depth_m: Spread  # distance outside of the owner's zone at the switch
    release_depth_m: Spread  # distance outside of the old zone at the commit of the switch
    failure_rate: float | None  # share of forced transfers; None without transfers

    @classmethod
    def of(
        cls,
        rows: Iterable[Transfer],  # for the percentiles
        # counts of one or more `TransferLog`s; they may include more transfers than `rows`
        counts: Mapping[str, int],
    ) -> TransferSummary:
        """Return the statistics of transfers."""
        kept = list(rows)
        forced = counts.get("forced", 0)
        transfers = forced + counts.get("switched", 0)
        deferred = counts.get("deferred", 0)
        return cls(
            transfers=transfers,
            forced=forced,
            removed=counts.get("removed", 0),
            deferred=deferred,
            refused=counts.get("refused", 0),
            aborted=counts.get("aborted", 0),
            timeouts={
                "acknowledge": deferred,
                "switch": forced,
                "replica": counts.get("expired", 0),
            },
            latency_ticks=Spread.of(row.ticks for row in kept),
            waited_ticks=Spread.of(row.waited for row in kept),
            latency_ms=_spread(row.ms for row in kept),
            state_bytes=Spread.of(row.state_bytes for row in kept if row.offers),
            prepare_depth_m=_spread(row.prepare_depth_m for row in kept),
            switch_depth_m=_spread(row.switch_depth_m for row in kept),
            release_depth_m=_spread(row.release_depth_m for row in kept),
            failure_rate=forced / transfers if transfers else None,
        )


def _spread(values: Iterable[float | None]) -> Spread:
    return Spread.of(value for value in values if value is not None)
