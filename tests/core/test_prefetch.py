"""Software prefetch changes no result, for valid and invalid indices."""

from __future__ import annotations

import re
from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.compiled import IS_PLAIN, kernel
from cavmarl.core.compiled.prefetch import prefetch

RECORD = np.dtype([("a", np.float64), ("b", np.int64, (9,))])


@kernel
def total(records: NDArray[np.void], places: NDArray[np.int64], ahead: int) -> float:
    found = 0.0
    for k in range(places.size):
        prefetch(records, places[k] + ahead, 1)
        found += records[places[k]]["a"]
    return found


@pytest.mark.parametrize("ahead", [0, 1, -1, 10**12, -(10**12)])
@pytest.mark.parametrize("stride", [1, 3])
def test_prefetching_changes_no_result(ahead: int, stride: int) -> None:
    records = np.zeros(60, dtype=RECORD)
    records["a"] = np.arange(60)
    view = records[::stride]
    before = records.tobytes()
    places = np.random.default_rng(0).permutation(len(view)).astype(np.int64)
    assert total(view, places, ahead) == view["a"].sum()
    assert records.tobytes() == before


def test_prefetching_an_empty_array_has_no_effect() -> None:
    assert total(np.zeros(0, dtype=RECORD), np.zeros(0, dtype=np.int64), 5) == 0.0


def test_the_compiled_code_has_prefetch_instructions() -> None:
    if IS_PLAIN:
        pytest.skip("without the compiler there is no such instruction")
    njit: Any = numba.njit
    function: Any = total
    compiled = njit(function.py_func)  # a kernel from the cache has no assembly text
    compiled(np.zeros(4, dtype=RECORD), np.arange(4, dtype=np.int64), 1)
    (code,) = compiled.inspect_asm().values()
    assert re.search(r"^\s+(prefetcht0|prfm)\s", code, re.MULTILINE)
