"""Bundles (named tuples of arrays) that a kernel creates in a loop and passes to other kernels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.buckets import Lists, make_lists


@inlined_kernel
def _with_bounds(lists: Lists, bounds: NDArray[np.int32]) -> Lists:
    return Lists(bounds, lists.used, lists.words)


@kernel
def _first_end(lists: Lists) -> int:
    return int(lists.bounds[0, 1])


@kernel
def _ends(
    lists: Lists, bounds: NDArray[np.int32], own: NDArray[np.bool_], ends: NDArray[np.int64]
) -> None:
    """Write the first end of each chosen bundle, read by a called kernel and by this kernel."""
    for k in range(own.size):
        here = _with_bounds(lists, bounds[k]) if own[k] else lists
        ends[k, 0] = _first_end(here)
        ends[k, 1] = here.bounds[0, 1]
        always = _with_bounds(lists, bounds[k])
        ends[k, 2] = _first_end(always)
        ends[k, 3] = always.bounds[0, 1]
        ends[k, 4] = here.used.size


def test_each_iteration_of_a_loop_reads_its_own_bundle() -> None:
    lists = make_lists(64)
    lists.bounds[0, 1] = 7
    bounds = np.zeros((4, 64, 2), dtype=np.int32)
    bounds[:, 0, 1] = 11, 12, 13, 14
    ends = np.zeros((4, 5), dtype=np.int64)
    _ends(lists, bounds, np.array([True, False, True, False]), ends)
    assert ends[:, 0].tolist() == ends[:, 1].tolist() == [11, 7, 13, 7]
    assert ends[:, 2].tolist() == ends[:, 3].tolist() == [11, 12, 13, 14]
    assert (ends[:, 4] == lists.used.size).all()
