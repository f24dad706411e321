"""What targets have acknowledged: the coordinator's volatile set "ready"."""

from __future__ import annotations

from collections import defaultdict

from cavmarl.ownership.messages import Ack
from cavmarl.ownership.safeguards import Safeguards


class Readiness:
    """Acknowledgements by tick: (vehicle, zone) → (incarnation, epoch, digest)."""

    def __init__(self, safeguards: Safeguards) -> None:
        self.held: defaultdict[int, dict[tuple[int, int], tuple[int, int, bytes]]]
        self.held = defaultdict(dict)
        self._safeguards = safeguards

    def note(self, ack: Ack, vehicle: int, epoch: int, digest: bytes) -> None:
        self.held[ack.tick][vehicle, ack.zone] = (ack.incarnation, epoch, digest)

    def ready(
        self, vehicle: int, zone: int, *, tick: int, epoch: int, incarnation: int, digest: bytes
    ) -> bool:
        """Whether the zone's living host holds exactly that state of the vehicle."""
        ticks = (tick,) if self._safeguards.ack_freshness else sorted(self.held, reverse=True)
        for heard in ticks:
            found = self.held.get(heard, {}).get((vehicle, zone))
            if found is None:
                continue
            return (
                (found[0] == incarnation or not self._safeguards.ack_incarnation)
                and (found[1] == epoch or not self._safeguards.ack_freshness)
                and (found[2] == digest or not self._safeguards.ack_digest)
            )
        return False

    def holder(self, vehicle: int, tick: int, otherwise: int) -> int:
        """A zone that holds the vehicle's state of the tick."""
        zones = [zone for held, zone in self.held.get(tick, {}) if held == vehicle]
        return min(zones, default=otherwise)

    def forget(self, before: int) -> None:
        if self._safeguards.ack_freshness:
            for tick in [tick for tick in self.held if tick < before]:
                del self.held[tick]
