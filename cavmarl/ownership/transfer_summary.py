"""What many transfers have in common: how many, how they ended, how long they took."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from cavmarl.ownership.transfers import Transfer


class Spread(NamedTuple):
    """Nearest-rank percentiles; all None without values."""

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
    """Of transfers and of what led to none."""

    transfers: int  # vehicles that have changed their owner
    forced: int  # of them, with the state attached, since no acknowledgement came in time
    removed: int  # of them, that left the world in the same tick
    deferred: int  # ticks in which a vehicle that had crossed stayed with its owner, summed
    refused: int  # states that a target did not take
    aborted: int  # approaches that ended without a transfer
    # by phase: `acknowledge`, no answer by the end of the tick (as many as `deferred`); `switch`,
    # none by the deadline (as many as `forced`); `replica`, states that were neither asked for nor
    # withdrawn in their lifetime
    timeouts: Mapping[str, int]
    latency_ticks: Spread  # from the first state at the target until it had confirmed
    waited_ticks: Spread  # of these, those behind the border
    latency_ms: Spread  # the same as `latency_ticks`, by the clock
    state_bytes: Spread  # of a vehicle
    # how far outside of its owner's zone at the first state, less than 0 inside
    prepare_depth_m: Spread
    switch_depth_m: Spread  # at the switch
    release_depth_m: Spread  # outside of its old zone when the switch was committed
    failure_rate: float | None  # share of transfers that had to be forced; None without transfers

    @classmethod
    def of(
        cls,
        rows: Iterable[Transfer],  # whose spread is told
        # of a `TransferLog`, or the sum of several; they may know of more transfers than there are
        # rows left
        counts: Mapping[str, int],
    ) -> TransferSummary:
        """A summary."""
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
