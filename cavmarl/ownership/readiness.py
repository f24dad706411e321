"""Acknowledgements by target zones, which the coordinator keeps outside of its log."""

from __future__ import annotations

from collections import defaultdict

from cavmarl.ownership.messages import Ack


class Readiness:
    """Acknowledgements by tick: (vehicle, zone) → (incarnation, epoch, digest)."""

    def __init__(self) -> None:
        self.held: defaultdict[int, dict[tuple[int, int], tuple[int, int, bytes]]]
        self.held = defaultdict(dict)

    def note(self, ack: Ack, vehicle: int, epoch: int, digest: bytes) -> None:
        self.held[ack.tick][vehicle, ack.zone] = (ack.incarnation, epoch, digest)

    def ready(
        self, vehicle: int, zone: int, *, tick: int, epoch: int, incarnation: int, digest: bytes
    ) -> bool:
        """Return whether the zone's current host has acknowledged exactly this state."""
        found = self.held.get(tick, {}).get((vehicle, zone))
        return found == (incarnation, epoch, digest)

    def forget(self, before: int) -> None:
        for tick in [tick for tick in self.held if tick < before]:
            del self.held[tick]
