"""Lists of items by key, stored consecutively."""

from __future__ import annotations

from collections.abc import Sequence


def laid_out(number: int, keys: Sequence[int]) -> list[range]:
    """Return the start and end of the items of each key, if items are sorted by key."""
    counts = [sum(key == k for key in keys) for k in range(number)]
    return [range(sum(counts[:k]), sum(counts[: k + 1])) for k in range(number)]
