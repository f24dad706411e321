"""The committed store in memory, as a minimal implementation of the contract of stores.

The store has the state of each vehicle at the committed tick, and segments for the next tick. Each
process writes to its own segment, and only `commit` makes the segments valid.
"""

from __future__ import annotations

from collections.abc import Mapping

from cavmarl.ownership.ledger import row_hash, state_digest, world_digest


class MemoryStore:
    """The committed state of each vehicle, as bytes.

    Attributes:
        segments: (zone, incarnation) → states that the process has written for the next tick.
    """

    def __init__(self) -> None:
        self.tick = 0  # the committed tick
        self.committed: dict[int, bytes] = {}  # vehicle → state at that tick
        self.segments: dict[tuple[int, int], dict[int, bytes]] = {}

    def state(self, vehicle: int) -> bytes:
        return self.committed[vehicle]

    def digest_of(self, vehicle: int) -> bytes:
        return state_digest(self.committed[vehicle])

    def write(self, zone: int, incarnation: int, vehicle: int, state: bytes) -> None:
        """Write the next state of a vehicle to the segment of a process."""
        self.segments.setdefault((zone, incarnation), {})[vehicle] = state

    def clear(self, zone: int, incarnation: int) -> None:
        """Discard the segment of a process."""
        self.segments.pop((zone, incarnation), None)

    def digest(self, zone: int, incarnation: int) -> int:
        rows = self.segments.get((zone, incarnation), {})
        return world_digest(row_hash(vehicle, state) for vehicle, state in rows.items())

    def commit(self, tick: int, incarnations: Mapping[int, int]) -> None:
        """Make the segments of the living hosts the state of `tick`.

        If a coordinator dies after it has logged a COMMIT, the restarted coordinator calls this
        function again. The segments still exist then.
        """
        self.committed = {
            vehicle: state
            for zone, incarnation in sorted(incarnations.items())
            for vehicle, state in self.segments.get((zone, incarnation), {}).items()
        }
        self.tick = tick
        self.segments.clear()

    def reset(self, tick: int) -> None:
        self.tick, self.committed = tick, {}
        self.segments.clear()

    def world(self) -> int:
        return world_digest(row_hash(vehicle, state) for vehicle, state in self.committed.items())
