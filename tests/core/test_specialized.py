from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numba.core.config
import numpy as np
import pytest
from numba.core.errors import NumbaTypeError
from numba.extending import typeof_impl
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.compiled import specialized as specialized_calls
from cavmarl.core.compiled import _kind, specialized

_typeof: Any = numba.typeof

settings: Any = numba.core.config
compiled_only = pytest.mark.skipif(
    settings.DISABLE_JIT or settings.BOUNDSCHECK, reason="the kernel itself is called"
)


class Pair(NamedTuple):
    counts: NDArray[np.int64]
    step: float


@kernel
def rise(pair: Pair, by: int) -> int:
    for k in range(pair.counts.size):
        pair.counts[k] += by
    return pair.counts[0]


def test_it_does_what_the_kernel_does_with_other_arrays_of_the_same_types() -> None:
    call = specialized(rise)
    for number in (1, 3):
        counts = np.arange(number)
        assert call(Pair(counts, 0.5), 4) == 4
        assert counts.tolist() == list(range(4, 4 + number))


@compiled_only
def test_types_are_looked_at_in_the_first_call_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    looked = []
    monkeypatch.setattr(
        specialized_calls, "_kind", lambda value: looked.append(value) or _kind(value)
    )
    call = specialized(rise)
    for _ in range(3):
        call(Pair(np.arange(2), 0.5), 1)
    assert len(looked) == 4  # the bundle, what is in it, and the number


RECORDS = np.zeros(3, dtype=[("x", np.float64), ("at", np.int64)])
TURNED = np.asfortranarray(np.zeros((2, 3)))
CONSTANT = np.zeros(3)
CONSTANT.flags.writeable = False
ARGUMENTS = [
    RECORDS,
    RECORDS[::2],
    RECORDS["x"],
    RECORDS.astype(np.dtype(RECORDS.dtype.descr, align=True)),
    RECORDS.view([("x", np.float64), ("by", np.int64)]),
    np.zeros(3),
    np.zeros(3, dtype=np.float32),
    np.zeros((2, 3)),
    TURNED,
    CONSTANT,
    3,
    True,
    0.5,
    None,
    (1, 2.0),
    (1, 2),
    (),
    Pair(np.arange(2), 0.5),
    Pair(np.arange(2), 1),  # type: ignore[arg-type]
    (Pair(np.arange(2), 0.5), RECORDS),
]


def numbas(value: Any) -> Any:
    """The type of a value, by Numba alone."""
    register: Any = typeof_impl.register(np.ndarray)
    register(specialized_calls._typeof_array)
    try:
        return _typeof(value)
    finally:
        register(specialized_calls._type_of_array)


@pytest.mark.parametrize("argument", ARGUMENTS, ids=lambda argument: repr(_typeof(argument)))
def test_types_that_are_kept_are_numbas(argument: Any) -> None:
    for value in (argument, *ARGUMENTS, argument):
        assert _kind(value) == _typeof(value) == numbas(value)
    assert _kind(argument) is _kind(argument)


def test_an_array_of_equal_records_has_the_type_that_was_kept() -> None:
    again = np.zeros(2, np.dtype(RECORDS.dtype.descr))
    assert again.dtype is not RECORDS.dtype
    assert _typeof(again) is _typeof(RECORDS)


def test_arrays_that_numba_refuses_are_refused() -> None:
    with pytest.raises(NumbaTypeError, match="MaskedArray"):
        _typeof(np.ma.MaskedArray(np.zeros(2)))


@pytest.mark.parametrize("setting", ["DISABLE_JIT", "BOUNDSCHECK"])
def test_where_kernels_are_checked_the_kernel_itself_is_called(
    setting: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(settings, setting, 1)
    assert specialized(rise) is rise


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
def test_another_type_is_an_error_and_nothing_is_written(other: Any) -> None:
    call = specialized(rise)
    call(Pair(np.arange(2), 0.5), 1)
    before = other[0].copy()
    with pytest.raises(TypeError, match="rise: an argument of"):
        call(other, 1)
    assert (other[0] == before).all()
    assert call(Pair(np.arange(2), 0.5), np.int64(1)) == 1  # type: ignore[arg-type]


@compiled_only
def test_an_array_that_cannot_be_written_is_an_error_where_the_first_one_could() -> None:
    call = specialized(rise)
    call(Pair(np.arange(2), 0.5), 1)
    counts = np.arange(2)
    counts.flags.writeable = False
    with pytest.raises(TypeError, match="readonly"):
        call(Pair(counts, 0.5), 1)
