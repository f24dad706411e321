"""Activation functions of driver networks, compared with exact functions."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.networks.kernels.activations import apply_clamp, apply_relu, apply_tanh, sigmoid

INFINITY = 0x7F800000  # bit pattern of infinity; smaller patterns are the finite numbers from 0
TANH_ULP = 7.0
TANH_ERROR = 4e-7
SIGMOID_ERROR = 3e-7


def check_tanh(bits: NDArray[np.uint32]) -> None:
    """Check `tanh` of numbers and of their negatives for the error bounds in its docstring."""
    numbers = bits.view(np.float32)
    found, negative = numbers.copy(), -numbers
    apply_tanh(found)
    apply_tanh(negative)
    np.testing.assert_array_equal(negative, -found)
    assert found.min() >= 0.0
    assert found.max() <= 1.0
    exact = np.tanh(numbers.astype(np.float64))
    error = np.abs(found - exact)
    assert error.max() <= TANH_ERROR
    # The error in units of the last place of a float32.
    _, exponent = np.frexp(exact)
    unit = np.ldexp(1.0, np.maximum(exponent - 24, -149))
    assert (error / unit).max() <= TANH_ULP


def test_tanh_is_close_to_the_exact_function() -> None:
    check_tanh(np.arange(0, INFINITY, 1511, dtype=np.uint32))
    near_end = np.array([9.0, 9.02], dtype=np.float32).view(np.uint32)
    check_tanh(np.arange(near_end[0], near_end[1], dtype=np.uint32))


@pytest.mark.slow
def test_tanh_is_close_to_the_exact_function_for_every_float32() -> None:
    step = 1 << 24
    for first in range(0, INFINITY, step):
        check_tanh(np.arange(first, min(first + step, INFINITY), dtype=np.uint32))


def test_functions_have_limits_for_infinite_numbers_and_keep_nan() -> None:
    special = np.array([np.inf, -np.inf, np.nan, -0.0], dtype=np.float32)
    found = special.copy()
    apply_tanh(found)
    np.testing.assert_array_equal(found, np.array([1.0, -1.0, np.nan, -0.0], dtype=np.float32))
    assert np.signbit(found[3])
    found = special.copy()
    apply_relu(found)
    np.testing.assert_array_equal(found, np.array([np.inf, 0.0, np.nan, 0.0], dtype=np.float32))
    found = special.copy()
    apply_clamp(found, np.float32(5.0))
    np.testing.assert_array_equal(found, np.array([5.0, -5.0, np.nan, 0.0], dtype=np.float32))
    assert np.isnan(sigmoid(np.float32("nan")))


def test_sigmoid_is_close_to_the_exact_function() -> None:
    numbers = np.linspace(-30.0, 30.0, 3001, dtype=np.float32)
    found = np.array([sigmoid(number) for number in numbers])
    exact = 1.0 / (1.0 + np.exp(-numbers.astype(np.float64)))
    assert found.min() >= 0.0
    assert found.max() <= 1.0
    assert np.abs(found - exact).max() <= SIGMOID_ERROR
