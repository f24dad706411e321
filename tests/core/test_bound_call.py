"""Bound calls (calls of a kernel with fixed arguments) and their sequences equal ordinary calls."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.compiled.bound_call import CallSequence, bind, bind_by_name, bound


@kernel
def add(numbers: NDArray[np.int64], amount: int) -> None:
    for n in range(numbers.size):
        numbers[n] += amount


@kernel
def compare(numbers: NDArray[np.int64], limit: int) -> tuple[bool, bool]:
    return numbers[0] > limit, numbers[0] < limit


@kernel
def is_even(numbers: NDArray[np.int64]) -> bool:
    return bool(numbers[0] % 2 == 0)


def test_a_bound_call_sees_changes_of_its_arrays_and_takes_arguments_by_name() -> None:
    numbers = np.arange(3)
    call = bind(add, amount=2, numbers=numbers)
    call()
    numbers[0] = 10
    call()
    assert numbers.tolist() == [12, 5, 6]
    assert bind(compare, numbers, 11)() == (True, False)


class _Numbers:
    """An object whose bound call adds `amount` to `numbers`."""

    def __init__(self) -> None:
        self.numbers, self.amount = np.arange(3), 5

    @property
    def values(self) -> dict[str, Any]:
        return {"amount": self.amount, "numbers": self.numbers, "unused": None}

    add = bound(add)


def test_a_bound_call_of_an_object_takes_its_values_by_parameter_name() -> None:
    one = _Numbers()
    one.amount = 7
    one.add()
    assert one.numbers.tolist() == [7, 8, 9]
    one.add()
    assert one.numbers.tolist() == [14, 15, 16]
    assert one.add is one.add, "the call was bound again"


def test_the_error_for_a_missing_value_names_the_parameter() -> None:
    with pytest.raises(KeyError, match="amount"):
        bind_by_name(add, {"numbers": np.arange(3)})


def test_an_argument_that_kernels_cannot_take_is_refused() -> None:
    if not bind(is_even, np.zeros(1, dtype=np.int64)).is_compiled:
        pytest.skip("without the compiler any argument is taken")
    with pytest.raises(TypeError, match="pass NumPy arrays"):
        bind(add, [1, 2], 1)  # type: ignore[arg-type]


@pytest.mark.parametrize("start", range(6))
def test_a_sequence_makes_only_the_calls_whose_conditions_hold(start: int) -> None:
    numbers, expected = np.array([start]), np.array([start])
    test, parity = bind(compare, numbers, 3), bind(is_even, numbers)
    sequence = CallSequence()
    sequence.call(test)
    with sequence.only_if(test, 0):
        sequence.call(bind(add, numbers, 10))
        sequence.call(parity)
        with sequence.only_if(parity):
            sequence.call(bind(add, numbers, 100))
    with sequence.only_if(test, 1):
        sequence.call(bind(add, numbers, 1000))
    sequence.call(bind(add, numbers, 10000))
    for _ in range(3):
        sequence.run()
        above, below = bool(expected[0] > 3), bool(expected[0] < 3)
        if above:
            expected += 10
            if expected[0] % 2 == 0:
                expected += 100
        if below:
            expected += 1000
        expected += 10000
    assert numbers.tolist() == expected.tolist()


def test_an_empty_sequence_does_nothing() -> None:
    CallSequence().run()
