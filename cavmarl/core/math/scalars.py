"""Guards for single numbers that several models share."""

from __future__ import annotations

from cavmarl.core.compiled import kernel

NEAR_ZERO = 0.01


@kernel
def clamp(value: float, low: float, high: float) -> float:
    """`value`, or the end of [low, high] that it lies beyond."""
    return min(max(value, low), high)


@kernel
def not_zero(value: float) -> float:
    """`value` kept at least `NEAR_ZERO` away from zero, on its own side, to be divided by.

    Highway-env's `utils.not_zero`: a standing car is taken to creep at 1 cm/s.
    """
    if abs(value) > NEAR_ZERO:
        return value
    return NEAR_ZERO if value >= 0.0 else -NEAR_ZERO
