"""Lists by lane or by link. Most lists are empty, so only lists in use are cleared and laid out.

List k is `[start[k], end[k])` of some array of records; an empty list has start = end. Lists are
built in three steps: `forget` the previous lists, `add` each item, `lay_out`. Then each `end` is
its list's start, and the caller increments it for each item that it stores.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel

BLOCK_BITS = 3
BLOCK = 1 << BLOCK_BITS
WORD = 8 * BLOCK


class Lists(NamedTuple):
    """N lists, and flags for the lists in use."""

    bounds: NDArray[np.int32]  # (N, 2) start and end
    used: NDArray[np.bool_]  # (N / 8,) for blocks of 8 lists
    words: NDArray[np.uint64]  # (N / 64,) the same memory, 8 blocks at a time


def make_lists(number: int, zeros: Callable[..., NDArray[Any]] = np.zeros) -> Lists:
    """Return at least `number` empty lists in arrays that `zeros` makes."""
    words = zeros(-(-number // WORD), dtype=np.uint64)
    return Lists(zeros((words.size * WORD, 2), dtype=np.int32), words.view(np.bool_), words)


@kernel
def forget(lists: Lists) -> None:
    for word in range(lists.words.size):
        if lists.words[word] != 0:
            for k in range(word * WORD, (word + 1) * WORD):
                lists.bounds[k, 0] = 0
                lists.bounds[k, 1] = 0
            lists.words[word] = 0


@inlined_kernel
def add(lists: Lists, k: int) -> None:
    """Count one more item for list k."""
    lists.bounds[k, 1] += 1
    lists.used[k >> BLOCK_BITS] = True


@kernel
def lay_out(lists: Lists) -> int:
    """Set the start of every list, in order, and return the number of items."""
    bounds = lists.bounds
    begin = 0
    for word in range(lists.words.size):
        if lists.words[word] == 0:
            continue
        for block in range(word * BLOCK, (word + 1) * BLOCK):
            if not lists.used[block]:
                continue
            for k in range(block * BLOCK, (block + 1) * BLOCK):
                number = bounds[k, 1]
                bounds[k, 0] = begin
                bounds[k, 1] = begin
                begin += number
    return begin
