"""The source's side of an approach: its offers to other zones.

For each vehicle and target, a tick has at most one PREPARE or ABORT. An unanswered PREPARE is sent
at most `Limits.attempts` times in its tick. After a refusal, the target receives no offer of the
vehicle for `Limits.backoff` ticks.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from cavmarl.core.errors import ProtocolError
from cavmarl.ownership.ledger import state_digest
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import Ack, Nack, Offer, Refusal, Withdrawn


class Approach(NamedTuple):
    """A vehicle that approaches a zone, and its state."""

    vehicle: int
    target: int
    state: bytes


class Offers:
    """The offers of one source.

    Attributes:
        open: (vehicle, target) → epoch of the last offer, if it has not been withdrawn.
        unanswered: (vehicle, target) → unanswered offer of this tick.
        refused_until: (vehicle, target) → first tick in which the vehicle may be offered again.
    """

    def __init__(self, limits: Limits) -> None:
        self.open: dict[tuple[int, int], int] = {}
        self.unanswered: dict[tuple[int, int], Offer] = {}
        self.refused_until: dict[tuple[int, int], int] = {}
        self.attempts = 0
        self._limits = limits

    def renew(
        self, tick: int, approaches: Iterable[Approach], epochs: Mapping[int, int]
    ) -> tuple[dict[int, tuple[Offer, ...]], dict[int, tuple[Withdrawn, ...]]]:
        """Replace the offers of the last tick.

        Returns:
            Target → offers, and target → earlier offers that are withdrawn.
        """
        self.refused_until = {pair: t for pair, t in self.refused_until.items() if t > tick}
        before, self.open, self.unanswered, self.attempts = self.open, {}, {}, 1
        for vehicle, target, state in approaches:
            if vehicle not in epochs:
                raise ProtocolError(f"a zone offers vehicle {vehicle}, but does not own it")
            pair, epoch = (vehicle, target), epochs[vehicle]
            if pair in self.refused_until:
                if pair in before:
                    self.open[pair] = before[pair]
                continue
            self.open[pair] = epoch
            self.unanswered[pair] = Offer(vehicle, epoch, state_digest(state), state)
        ended: defaultdict[int, list[Withdrawn]] = defaultdict(list)
        for (vehicle, target), epoch in before.items():
            if (vehicle, target) not in self.open:
                ended[target].append(Withdrawn(vehicle, epoch))
        withdrawn = {target: tuple(sorted(entries)) for target, entries in sorted(ended.items())}
        return self._by_target(), withdrawn

    def forget(self, vehicle: int) -> None:
        """Forget a handed-over vehicle: an ABORT could reach its target before the STEP."""
        for pair in [pair for pair in self.open if pair[0] == vehicle]:
            del self.open[pair]

    def again(self) -> dict[int, tuple[Offer, ...]]:
        """Return unanswered offers, target → offers; empty after the last attempt."""
        if self.attempts >= self._limits.attempts:
            return {}
        self.attempts += 1
        return self._by_target()

    def answered(self, ack: Ack) -> None:
        for vehicle, epoch, digest in ack.entries:
            offer = self.unanswered.get((vehicle, ack.zone))
            if offer is not None and (offer.epoch, offer.digest) == (epoch, digest):
                del self.unanswered[vehicle, ack.zone]

    def refused(self, nack: Nack) -> None:
        """Stop offers of refused vehicles to a target for some ticks; repeat damaged offers."""
        for vehicle, _, reason in nack.entries:
            if reason is not Refusal.DIGEST and (vehicle, nack.zone) in self.unanswered:
                del self.unanswered[vehicle, nack.zone]
                self.refused_until[vehicle, nack.zone] = nack.tick + 1 + self._limits.backoff

    def _by_target(self) -> dict[int, tuple[Offer, ...]]:
        targets: defaultdict[int, list[Offer]] = defaultdict(list)
        for (_, target), offer in self.unanswered.items():
            targets[target].append(offer)
        return {target: tuple(sorted(offers)) for target, offers in sorted(targets.items())}
