"""What the classes of a configuration refuse values with."""

from __future__ import annotations

import math

from cavmarl.core.errors import ConfigError

__all__ = ["check", "check_finite"]


def check(holds: bool, key: str, value: object, expected: str) -> None:
    """Raise a ConfigError that names key, value and expectation unless `holds`."""
    if not holds:
        raise ConfigError(f"{key} = {value!r}: {expected}")


def check_finite(key: str, value: float, low: float, high: float) -> None:
    """Raise a ConfigError unless `value` is a finite number from `low` to `high`."""
    check(
        math.isfinite(value) and low <= value <= high,
        key,
        value,
        f"must be a number from {low:g} to {high:g}",
    )
