"""The replicas that a zone host keeps of vehicles that may enter, and their fences.

A fence is the newest (epoch, tick) of a vehicle in any PREPARE or ABORT so far. Messages that are
not newer than the fence are ignored, so the order of arrival does not matter. Messages older than
`Limits.lifetime` are ignored as well, so that older fences can be forgotten.
"""

from __future__ import annotations

from collections import defaultdict
from typing import NamedTuple

from cavmarl.ownership.ledger import state_digest
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import Offer, Refusal
from cavmarl.ownership.transitions import Event, Party, State, after


class Replica(NamedTuple):
    """A copy of the state of a vehicle at a tick; it is never advanced."""

    epoch: int
    tick: int
    digest: bytes
    state: bytes


class Replicas:
    """The replicas of one host, by vehicle.

    Attributes:
        fences: vehicle → (epoch, tick) of the newest PREPARE or ABORT so far.
    """

    def __init__(self, limits: Limits) -> None:
        self.held: dict[int, Replica] = {}  # vehicle → replica
        self.fences: dict[int, tuple[int, int]] = {}
        self._fenced_at: defaultdict[int, list[int]] = defaultdict(list)  # tick → vehicles
        self._limits = limits

    def state(self, vehicle: int) -> State:
        return State.PREPARED if vehicle in self.held else State.EMPTY

    def prepare(self, offer: Offer, tick: int, schema: int) -> Refusal | bool:
        """Store a state. Return whether it is stored (False: it was too late), or the refusal."""
        held = self.held.get(offer.vehicle)
        if not self._newer(offer.vehicle, offer.epoch, tick):
            return held is not None and held[:3] == (offer.epoch, tick, offer.digest)
        if state_digest(offer.state) != offer.digest:
            return Refusal.DIGEST  # damaged in transit; no fence is set, so it may be sent again
        if schema != self._limits.schema:
            return self.refuse(offer, tick, Refusal.SCHEMA)
        if held is None and len(self.held) >= self._limits.capacity:
            return self.refuse(offer, tick, Refusal.LOAD)
        after(Party.REPLICA, self.state(offer.vehicle), Event.PREPARE)
        self.held[offer.vehicle] = Replica(offer.epoch, tick, offer.digest, offer.state)
        self._raise_fence(offer.vehicle, offer.epoch, tick)
        return True

    def refuse(self, offer: Offer, tick: int, reason: Refusal) -> Refusal:
        """Raise the fence to the offered epoch and tick; store no state. Return `reason`."""
        self._raise_fence(offer.vehicle, offer.epoch, tick)
        return reason

    def abort(self, vehicle: int, epoch: int, tick: int) -> bool:
        """Drop a replica. Return False if the message is not newer than the fence."""
        if not self._newer(vehicle, epoch, tick):
            return False
        after(Party.REPLICA, self.state(vehicle), Event.ABORT)
        self.held.pop(vehicle, None)
        self._raise_fence(vehicle, epoch, tick)
        return True

    def exact(self, vehicle: int, epoch: int, tick: int, digest: bytes) -> bool:
        held = self.held.get(vehicle)
        return held is not None and held[:3] == (epoch, tick, digest)

    def take(self, vehicle: int) -> bytes:
        """Remove a replica, and return its state; b"" if there is none. The fence stays."""
        after(Party.REPLICA, self.state(vehicle), Event.IN)
        held = self.held.pop(vehicle, None)
        return b"" if held is None else held.state

    def expire(self, now: int) -> None:
        """Drop replicas that were not refreshed for `Limits.lifetime` ticks, with their fences."""
        last = now - self._limits.lifetime
        if not self._fenced_at or min(self._fenced_at) > last:
            return
        for tick in sorted(tick for tick in self._fenced_at if tick <= last):
            for vehicle in self._fenced_at.pop(tick):
                if self.fences.get(vehicle, (0, now))[1] <= last:
                    del self.fences[vehicle]
                    if vehicle in self.held:
                        after(Party.REPLICA, State.PREPARED, Event.EXPIRE)
                        del self.held[vehicle]

    def _newer(self, vehicle: int, epoch: int, tick: int) -> bool:
        return (epoch, tick) > self.fences.get(vehicle, (-1, -1))

    def _raise_fence(self, vehicle: int, epoch: int, tick: int) -> None:
        self.fences[vehicle] = max((epoch, tick), self.fences.get(vehicle, (-1, -1)))
        self._fenced_at[tick].append(vehicle)
