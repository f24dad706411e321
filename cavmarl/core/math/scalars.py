"""Limits for single numbers that several models share."""

from __future__ import annotations

from cavmarl.core.compiled import kernel

NEAR_ZERO = 0.01


@kernel
def clamp(value: float, low: float, high: float) -> float:
    """Return `value`, limited to [low, high]."""
    return min(max(value, low), high)


@kernel
def not_zero(value: float) -> float:
    """Return `value`, moved at least `NEAR_ZERO` away from zero, for use as a divisor.

    Highway-env's `utils.not_zero`: a stopped car is assumed to creep at 1 cm/s.
    """
    if abs(value) > NEAR_ZERO:
        return value
    return NEAR_ZERO if value >= 0.0 else -NEAR_ZERO
