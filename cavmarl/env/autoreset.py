"""Gymnasium's autoreset modes: when a world whose episode is over begins a new one."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, EpisodeError


def known_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """Return Gymnasium's mode of that name.

    Raises:
        ConfigError: there is no such mode.
    """
    try:
        return AutoresetMode(mode)
    except ValueError:
        raise ConfigError(
            f"autoreset_mode = {mode!r}: must be 'SameStep', 'NextStep' or 'Disabled'"
        ) from None


def present_mode(in_next_step: bool, disabled: bool) -> AutoresetMode:
    """Return Gymnasium's mode for worlds that reset in the next or the same step, or never."""
    if disabled:
        return AutoresetMode.DISABLED
    return AutoresetMode.NEXT_STEP if in_next_step else AutoresetMode.SAME_STEP


def refuse_over(over: NDArray[np.bool_]) -> None:
    """Raise an error if a world still waits for a reset.

    Raises:
        EpisodeError: the episode of a world (W,) is over.
    """
    if over.any():
        raise EpisodeError(
            f"the episode of world {int(over.argmax())} is over, and autoreset_mode is 'Disabled': "
            "call reset(options={'reset_mask': …}) before the next step()"
        )


def with_rows(array: NDArray[Any], others: NDArray[Any], chosen: NDArray[np.bool_]) -> NDArray[Any]:
    """Return a copy of an array (W, …) with the chosen rows (W,) taken from another array."""
    found = array.copy()
    found[chosen] = others[chosen]
    return found
