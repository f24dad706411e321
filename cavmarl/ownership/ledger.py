"""Counts and digests of sets, which are cheap to update and independent of order.

A set's digest is the sum of its members' keyed hashes modulo a power of two (invariant I10). If two
sets have the same count and digest, they differ only with a probability of 2**-64.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from functools import lru_cache
from hashlib import blake2b
from typing import NamedTuple

from cavmarl.core.errors import ProtocolError

_ID = struct.Struct("<q")
_WORLD = 1 << 128
_OWNED = 1 << 64
_WORD = _OWNED - 1
DIGEST_BYTES = 16


# Cached, because one transfer needs the digest of a state in five places.
@lru_cache(maxsize=256)
def state_digest(state: bytes) -> bytes:
    """Return the digest, 16 bytes, of one vehicle's state."""
    return blake2b(state, digest_size=DIGEST_BYTES).digest()


def row_hash(vehicle: int, state: bytes) -> int:
    """Return a row's term in the digest of the world, in [0, 2**128)."""
    return int.from_bytes(
        blake2b(_ID.pack(vehicle) + state, digest_size=16, person=b"cavmarl row").digest(), "little"
    )


def world_digest(parts: Iterable[int]) -> int:
    """Return the digest of a world from the digests of its rows or of its zones."""
    return sum(parts) % _WORLD


class OwnedTally(NamedTuple):
    """The number of vehicles that a zone owns, and the digest of their (id, epoch)."""

    vehicles: int = 0
    digest: int = 0

    def plus(self, run: bytes, vehicle: int, epoch: int) -> OwnedTally:
        return OwnedTally(self.vehicles + 1, (self.digest + member(run, vehicle, epoch)) % _OWNED)

    def minus(self, run: bytes, vehicle: int, epoch: int) -> OwnedTally:
        return OwnedTally(self.vehicles - 1, (self.digest - member(run, vehicle, epoch)) % _OWNED)

    def check(self, other: OwnedTally, where: str) -> None:
        """Compare with another tally. Raises ProtocolError if they differ."""
        if self == other:
            return
        difference = (
            f"{other.vehicles} vehicles instead of {self.vehicles}"
            if self.vehicles != other.vehicles
            else f"{self.vehicles} vehicles as expected, but with other ids or epochs"
        )
        raise ProtocolError(f"{where}: {difference}")


def member(run: bytes, vehicle: int, epoch: int) -> int:
    """Return the keyed hash of an owned vehicle, in [0, 2**64).

    This is SplitMix64's finalizer (Steele, Lea, Flood 2014). It has to be fast: it runs
    several times per tick. It detects sets that differ by mistake, but does not withstand attacks.
    """
    word = int.from_bytes(run[:8], "little") + vehicle * 0x9E3779B97F4A7C15
    word = (word + epoch * 0xC2B2AE3D27D4EB4F) & _WORD
    word = ((word ^ (word >> 30)) * 0xBF58476D1CE4E5B9) & _WORD
    word = ((word ^ (word >> 27)) * 0x94D049BB133111EB) & _WORD
    return word ^ (word >> 31)


def tally(run: bytes, owned: Mapping[int, int]) -> OwnedTally:
    return OwnedTally(
        len(owned), sum(member(run, vehicle, epoch) for vehicle, epoch in owned.items()) % _OWNED
    )


class SeenIds:
    """The ids that have been used in an episode: all ids below `floor`, and the ids in `above`.

    The set is small if ids are assigned roughly in ascending order.
    """

    def __init__(self, floor: int = 0, above: Iterable[int] = ()) -> None:
        self.floor = floor
        self.above = set(above)

    def __contains__(self, vehicle: int) -> bool:
        return vehicle < self.floor or vehicle in self.above

    def add(self, vehicle: int) -> None:
        self.above.add(vehicle)
        while self.floor in self.above:
            self.above.remove(self.floor)
            self.floor += 1
