"""Checks of seeds, and the default seed."""

from __future__ import annotations

from typing import Any

import numpy as np

from cavmarl.core.errors import ConfigError

SEED_BITS = 63


def check_seed(seed: Any) -> int:
    """Return a valid seed as an int; raise a ConfigError for any other value."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)):
        raise ConfigError(f"seed = {seed!r}: must be a whole number")
    if not 0 <= int(seed) < 1 << SEED_BITS:
        raise ConfigError(f"seed = {seed}: must be from 0 to 2**{SEED_BITS} - 1")
    return int(seed)


def first_seed(given: Any, default: int | None) -> int:
    """Return the seed of a reset: the given seed, else the default, else a random seed.

    Raises:
        ConfigError: the given seed is not valid; see `check_seed`.
    """
    if given is not None:
        return check_seed(given)
    if default is not None:
        return default
    return int(np.random.SeedSequence().generate_state(1, np.uint64)[0] >> np.uint64(1))
