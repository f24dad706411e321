"""Activation functions in float32, built from IEEE additions, multiplications and divisions only.

Library functions such as `tanhf` differ between processors. The functions here do not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel

Float32s = NDArray[np.float32]

ZERO = np.float32(0.0)
HALF = np.float32(0.5)
ONE = np.float32(1.0)

# tanh(x) ≈ x · P(x²) / Q(x²): a minimax fit of the relative error, which is below 3e-8 before
# rounding. All coefficients are positive, so no sum cancels. At TANH_END the quotient is exactly 1;
# beyond it, the exact value rounds to ±1.
TANH_END = np.float32(9.015)
_P1 = np.float32(0.13380328)  # P0 and Q0 are 1
_P2 = np.float32(0.0034947577)
_P3 = np.float32(2.0595378e-05)
_P4 = np.float32(1.3335603e-08)
_Q1 = np.float32(0.4671364)
_Q2 = np.float32(0.025873825)
_Q3 = np.float32(0.0003284275)
_Q4 = np.float32(7.768773e-07)


@inlined_kernel
def tanh(x: np.float32) -> np.float32:
    """Return the hyperbolic tangent of `x`.

    The error is at most 7 ULP of the exact value and at most 4e-7 for every float32. The function
    is odd, and its values lie in [-1, 1]. The result for NaN is NaN.
    """
    if x > TANH_END:
        x = TANH_END
    elif x < -TANH_END:
        x = -TANH_END
    square = x * x
    numerator = x * ((((_P4 * square + _P3) * square + _P2) * square + _P1) * square + ONE)
    denominator = (((_Q4 * square + _Q3) * square + _Q2) * square + _Q1) * square + ONE
    value = numerator / denominator
    if value > ONE:
        value = ONE
    elif value < -ONE:
        value = -ONE
    return value


@inlined_kernel
def sigmoid(x: np.float32) -> np.float32:
    """Return 1 / (1 + exp(-x)), with an absolute error of at most 3e-7.

    The result for NaN is NaN.
    """
    return HALF * tanh(HALF * x) + HALF


@kernel
def apply_tanh(values: Float32s) -> None:
    """Replace each of `values` (n,) by its hyperbolic tangent."""
    for i in range(values.shape[0]):
        values[i] = tanh(values[i])


@kernel
def apply_relu(values: Float32s) -> None:
    """Replace each negative element of `values` (n,) by 0; NaN stays NaN."""
    for i in range(values.shape[0]):
        if values[i] < ZERO:
            values[i] = ZERO


@kernel
def apply_clamp(values: Float32s, limit: np.float32) -> None:
    """Restrict each of `values` (n,) to [-limit, limit]; NaN stays NaN."""
    for i in range(values.shape[0]):
        value = values[i]
        if value > limit:
            value = limit
        elif value < -limit:
            value = -limit
        values[i] = value
