"""Digests of rows, computed with Python integers."""

from __future__ import annotations

WORD = (1 << 64) - 1


def mixed(word: int) -> int:
    """Apply the finaliser of SplitMix64."""
    word = ((word ^ (word >> 30)) * 0xBF58476D1CE4E5B9) & WORD
    word = ((word ^ (word >> 27)) * 0x94D049BB133111EB) & WORD
    return word ^ (word >> 31)


def digest(rows: list[list[int]], masks: list[int], factors: list[int]) -> int:
    """Return the sum of the digests of rows of words."""
    total = 0
    for row in rows:
        words = zip(row, masks, factors, strict=True)
        total += mixed(sum((word & mask) * factor for word, mask, factor in words) & WORD)
    return total % (1 << 128)
