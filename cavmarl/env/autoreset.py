"""When worlds that are over begin anew, by Gymnasium's names for it."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, EpisodeError


def known_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """Gymnasium's mode of that name.

    Raises:
        ConfigError: there is none.
    """
    try:
        return AutoresetMode(mode)
    except ValueError:
        raise ConfigError(
            f"autoreset_mode = {mode!r}: must be 'SameStep', 'NextStep' or 'Disabled'"
        ) from None


def present_mode(in_next_step: bool, disabled: bool) -> AutoresetMode:
    """The mode of worlds that would begin anew in the next step, or in the same."""
    if disabled:
        return AutoresetMode.DISABLED
    return AutoresetMode.NEXT_STEP if in_next_step else AutoresetMode.SAME_STEP


def refuse_over(over: NDArray[np.bool_]) -> None:
    """Refuse a step of worlds of which some wait for a reset.

    Raises:
        EpisodeError: a world is over; (W,).
    """
    if over.any():
        raise EpisodeError(
            f"world {int(over.argmax())} is over, and autoreset_mode is 'Disabled': call "
            "reset(options={'reset_mask': …}) before the next step()"
        )


def with_rows(array: NDArray[Any], others: NDArray[Any], chosen: NDArray[np.bool_]) -> NDArray[Any]:
    """A copy of an array (W, …) with the chosen rows (W,) of another one."""
    found = array.copy()
    found[chosen] = others[chosen]
    return found
