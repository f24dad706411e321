"""Calls of compiled kernels: arguments of each type, results, and released references."""

from __future__ import annotations

import gc
import threading
import weakref
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.compiled import IS_PLAIN, kernel, specialized, unchecked
from cavmarl.core.compiled.arguments import type_key, type_of
from cavmarl.core.compiled.kernel import CHECKS_INDICES

_typeof: Any = numba.typeof

compiled_only = pytest.mark.skipif(IS_PLAIN, reason="the kernel is a Python function")


class Pair(NamedTuple):
    counts: NDArray[np.int64]
    step: float


class Nested(NamedTuple):
    pair: Pair
    weights: tuple[float, int]
    nothing: None
    grid: NDArray[np.float32]


@kernel
def rise(pair: Pair, by: int) -> int:
    for k in range(pair.counts.size):
        pair.counts[k] += by
    return pair.counts[0]


@kernel
def read_nested(nested: Nested, flag: bool, scale: float) -> tuple[float, int, bool]:
    total = 0.0
    for i in range(nested.grid.shape[0]):
        for j in range(nested.grid.shape[1]):
            total += nested.grid[i, j]
    total += nested.pair.step * nested.weights[0] * scale
    return total, nested.pair.counts.size + nested.weights[1], not flag


@kernel
def same_number(number: Any) -> Any:
    return number


@kernel
def read_record(record: np.void) -> float:
    return record["x"] + record["at"]


@kernel
def with_defaults(a: int, b: int = 5, c: float = 0.5) -> float:
    return a + 10 * b + 100 * c


@kernel
def total_of(values: NDArray[np.float64]) -> float:
    total = 0.0
    for k in range(values.shape[0]):
        total += values[k]
    return total


def test_kernels_receive_bundles_tuples_and_none_unchanged() -> None:
    grid = np.arange(12, dtype=np.float32).reshape(3, 4)
    for view in (grid, grid.T, grid[::2], np.asfortranarray(grid), grid[:1], grid[:0]):
        nested = Nested(Pair(np.arange(3), 0.25), (2.0, 7), None, view)
        total, count, flag = read_nested(nested, False, 4.0)
        assert total == float(view.sum()) + 2.0
        assert (count, flag) == (10, True)


@pytest.mark.parametrize(
    "number",
    [0, -1, 2**62, -(2**63), 2**63 + 5, 1.5, -0.0, float("inf"), True, False, np.int32(-7),
     np.uint8(200), np.uint64(2**64 - 1), np.float32(0.1), np.float64(0.1), np.bool_(True)],
)  # fmt: skip
def test_kernels_return_numbers(number: Any) -> None:
    found = same_number(number)
    assert found == number
    assert repr(float(found)) == repr(float(number))
    if not IS_PLAIN:
        assert type(found) is type(number.item() if isinstance(number, np.generic) else number)


def test_records_of_an_array_are_arguments() -> None:
    records = np.zeros(3, dtype=[("x", np.float64), ("at", np.int64)])
    records["x"], records["at"] = [0.5, 1.5, 2.5], [10, 20, 30]
    assert [read_record(record) for record in records] == [10.5, 21.5, 32.5]


def test_arguments_can_be_named_or_have_defaults() -> None:
    assert with_defaults(1) == 101.0
    assert with_defaults(1, 2) == 71.0
    assert with_defaults(c=1.0, a=3) == 153.0
    with pytest.raises(TypeError, match=r"missing (a|1) required"):
        with_defaults()  # type: ignore[call-arg]


@compiled_only
def test_unsupported_arguments_raise_type_errors() -> None:
    with pytest.raises(TypeError, match=r"is a builtins\.str; pass NumPy arrays"):
        same_number("word")
    with pytest.raises(TypeError, match=r"is a builtins\.list"):
        same_number([1])


@pytest.mark.parametrize("call", [total_of, unchecked(total_of)])
def test_no_reference_to_an_array_remains_after_a_call(call: Any) -> None:
    values = np.ones(3)
    assert call(values) == 3.0
    gone = weakref.ref(values)
    del values
    gc.collect()
    assert gone() is None


def test_changes_of_an_array_are_read_in_the_next_call() -> None:
    call = specialized(total_of)
    values = np.ones(4)
    assert call(values) == 4.0
    values.shape = (2, 2)
    values.shape = (4,)
    values[:] = 2.0
    assert call(values) == 8.0


def test_threads_call_one_kernel_at_the_same_time() -> None:
    call = specialized(total_of)
    arrays = [np.full(200_000, float(k)) for k in range(8)]
    wrong = []

    def work(array: NDArray[np.float64]) -> None:
        for _ in range(20):
            for function in (call, total_of):
                if function(array) != array[0] * len(array):
                    wrong.append(array[0])

    threads = [threading.Thread(target=work, args=(array,)) for array in arrays]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_a_specialized_kernel_works_on_other_arrays_of_the_same_types() -> None:
    call = specialized(rise)
    for number in (1, 3):
        counts = np.arange(number)
        assert call(Pair(counts, 0.5), 4) == 4
        assert counts.tolist() == list(range(4, 4 + number))


RECORDS = np.zeros(3, dtype=[("x", np.float64), ("at", np.int64)])
CONSTANT = np.zeros(3)
CONSTANT.flags.writeable = False
ARGUMENTS = [
    RECORDS,
    RECORDS[::2],
    RECORDS["x"],
    RECORDS.view([("x", np.float64), ("by", np.int64)]),
    np.zeros(3),
    np.zeros(3, dtype=np.float32),
    np.zeros((2, 3)),
    np.zeros((1, 3)),
    np.asfortranarray(np.zeros((2, 3))),
    np.zeros((4, 3))[::2],
    np.zeros(0),
    CONSTANT,
    RECORDS[0],
    3,
    2**63,
    True,
    np.True_,
    0.5,
    np.float64(0.5),
    np.float32(0.5),
    None,
    (1, 2.0),
    (1, 2),
    (),
    Pair(np.arange(2), 0.5),
    Pair(np.arange(2), 1),  # type: ignore[arg-type]
    (Pair(np.arange(2), 0.5), RECORDS),
]


def test_arguments_have_equal_types_exactly_if_their_types_in_numba_are_equal() -> None:
    for one in ARGUMENTS:
        for other in ARGUMENTS:
            is_same = _typeof(one) == _typeof(other)
            assert (type_of(one).text == type_of(other).text) == is_same, (one, other)
            if type_key(one) == type_key(other):
                assert is_same


@compiled_only
@pytest.mark.parametrize(
    "other",
    [
        Pair(np.arange(3, dtype=np.int32), 0.5),
        Pair(np.arange(3, dtype=np.float64), 0.5),  # type: ignore[arg-type]
        Pair(np.arange(6)[::2], 0.5),
        Pair(np.arange(6).reshape(2, 3), 0.5),
        Pair(np.arange(3), 1),
        (np.arange(3), 0.5),
    ],
)
def test_an_argument_of_another_type_is_an_error_and_nothing_is_written(other: Any) -> None:
    call = specialized(rise)
    call(Pair(np.arange(2), 0.5), 1)
    before = other[0].copy()
    with pytest.raises(TypeError, match="rise: an argument has the type"):
        call(other, 1)
    assert (other[0] == before).all()
    counts = np.arange(2)
    assert call(Pair(counts, 0.5), np.int64(1)) == 1  # type: ignore[arg-type]
    assert counts.tolist() == [1, 2]


@compiled_only
def test_a_read_only_array_in_place_of_a_writable_one_is_an_error() -> None:
    call = specialized(rise)
    call(Pair(np.arange(2), 0.5), 1)
    counts = np.arange(2)
    counts.flags.writeable = False
    with pytest.raises(TypeError, match="readonly"):
        call(Pair(counts, 0.5), 1)


@pytest.mark.skipif(not CHECKS_INDICES, reason="NUMBA_BOUNDSCHECK=1 checks indices")
def test_an_index_out_of_bounds_is_an_error() -> None:
    with pytest.raises(IndexError, match="rise: an index is out of bounds"):
        rise(Pair(np.zeros(0, np.int64), 0.5), 1)
