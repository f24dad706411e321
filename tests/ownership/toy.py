"""A toy world for the protocol: vehicles on a torus with integer positions.

The next state of a vehicle is a hash of its own state and of all states near it. A state that
is computed from a wrong state, and all later states, therefore differ from the undivided world.
"""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from hashlib import blake2b

from cavmarl.ownership.ledger import row_hash, world_digest

REACH = 6
STRIDE = 3
LEAVES_ONE_IN = 50

_STATE = struct.Struct("<hhQ")


def pack(x: int, y: int, memory: int) -> bytes:
    return _STATE.pack(x, y, memory)


def place(state: bytes) -> tuple[int, int]:
    x, y, _ = _STATE.unpack(state)
    return x, y


def number(*parts: object) -> int:
    """Return a 64-bit hash of the arguments."""
    return int.from_bytes(blake2b(repr(parts).encode(), digest_size=8).digest(), "little")


@dataclass(frozen=True)
class ToyWorld:
    """The size, the entering vehicles and the zones of the world, cut at `cuts_x` and `cuts_y`."""

    size: int = 24
    cuts_x: tuple[int, ...] = (12,)
    cuts_y: tuple[int, ...] = ()
    vehicles: int = 8
    born_each_tick: float = 0.2
    seed: int = 0
    leaving: bool = True

    @property
    def zones(self) -> range:
        return range((len(self.cuts_x) + 1) * (len(self.cuts_y) + 1))

    def zone(self, state: bytes) -> int:
        return self._zone_at(*place(state))

    def near(self, state: bytes, distance: int) -> set[int]:
        """Return the zones that a square around a vehicle overlaps."""
        x, y = place(state)
        offsets = range(-distance, distance + 1)
        columns = {bisect_right(self.cuts_x, (x + d) % self.size) for d in offsets}
        rows = {bisect_right(self.cuts_y, (y + d) % self.size) for d in offsets}
        return {row * (len(self.cuts_x) + 1) + column for row in rows for column in columns}

    def births(self, tick: int, next_id: int) -> list[tuple[int, bytes]]:
        """Return the vehicles that enter at a tick, with their states."""
        count = self.vehicles if next_id == 0 else 0
        if number(self.seed, "birth", tick) % 1000 < 1000 * self.born_each_tick:
            count += 1
        return [(next_id + k, self._newborn(tick, next_id + k)) for k in range(count)]

    def advance(
        self, vehicle: int, state: bytes, others: Mapping[int, bytes], tick: int
    ) -> bytes | None:
        """Return the next state of a vehicle, or None if it leaves the world."""
        x, y, _ = _STATE.unpack(state)
        digest = blake2b(struct.pack("<qqq", self.seed, vehicle, tick) + state, digest_size=8)
        for other in sorted(others):
            if other != vehicle and self._touches(x, y, others[other]):
                digest.update(struct.pack("<q", other) + others[other])
        memory = int.from_bytes(digest.digest(), "little")
        if self.leaving and memory % LEAVES_ONE_IN == 0:
            return None
        return pack(
            (x + memory // 7 % (2 * STRIDE + 1) - STRIDE) % self.size,
            (y + memory // 77 % (2 * STRIDE + 1) - STRIDE) % self.size,
            memory,
        )

    def undivided(self, ticks: int) -> list[int]:
        """Return the digest of the undivided world after each tick."""
        states: dict[int, bytes] = {}
        digests, next_id = [], 0
        for tick in range(1, ticks + 1):
            born = self.births(tick, next_id)
            next_id += len(born)
            now = states | dict(born)
            after = {v: self.advance(v, state, now, tick) for v, state in now.items()}
            states = {v: state for v, state in after.items() if state is not None}
            digests.append(digest(states.items()))
        return digests

    def _zone_at(self, x: int, y: int) -> int:
        column, row = bisect_right(self.cuts_x, x), bisect_right(self.cuts_y, y)
        return row * (len(self.cuts_x) + 1) + column

    def _newborn(self, tick: int, vehicle: int) -> bytes:
        memory = number(self.seed, "newborn", tick, vehicle)
        return pack(memory % self.size, memory // 101 % self.size, memory)

    def _touches(self, x: int, y: int, other: bytes) -> bool:
        ox, oy = place(other)
        half = self.size // 2
        return (
            abs((x - ox + half) % self.size - half) <= REACH
            and abs((y - oy + half) % self.size - half) <= REACH
        )


def digest(rows: Iterable[tuple[int, bytes]]) -> int:
    return world_digest(row_hash(vehicle, state) for vehicle, state in rows)
