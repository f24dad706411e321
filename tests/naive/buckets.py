"""Lists of items by key, one after the other."""

from __future__ import annotations

from collections.abc import Sequence


def laid_out(number: int, keys: Sequence[int]) -> list[range]:
    """Where the items of each key lie when all stand in the order of keys."""
    counts = [sum(key == k for key in keys) for k in range(number)]
    return [range(sum(counts[:k]), sum(counts[: k + 1])) for k in range(number)]
