"""Controllers of speed limits, which choose limits from the observations of agents."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.limits import LimitsConfig
from cavmarl.core.errors import ConfigError
from cavmarl.limits.kernels.limit_steps import DENSITY_SCALE, OF_SECTION
from cavmarl.limits.limit_table import LimitTable
from cavmarl.signals.kernels.green_choices import GREEN, KEEP


class LimitView(NamedTuple):
    """The inputs of controllers, in W worlds.

    Attributes:
        config: speeds and kind of action.
        table: the U units and their sections.
        observations: (W, U, D) observations of the agents.
        ticks: (W,) ticks since the reset.
        states: (W, U, HELD) states of the units; see `LimitOutputs`.
        masks: (W, U, C) allowed choices.
        decides: (W,) whether it is time for a decision.
    """

    config: LimitsConfig
    table: LimitTable
    observations: NDArray[np.float32]
    ticks: NDArray[np.int64]
    states: NDArray[np.int64]
    masks: NDArray[np.bool_]
    decides: NDArray[np.bool_]


class LimitController(Protocol):
    """A controller of all units."""

    def choose(self, view: LimitView) -> NDArray[np.int64]:
        """Return the choice (W, U) of each agent; KEEP where it is not time for a decision."""
        ...


class Feedback:
    """Sets the lowest allowed limit if the density of the watched section is above the target.

    Otherwise, it raises the limit to the next entry of `limits.speeds_mps`. A low limit before a
    queue reduces the inflow for a while, so that the queue dissolves.

    Source of the principle: Hegyi, Hoogendoorn, Schreuder, Stoelhorst, Viti, "SPECIALIST: A dynamic
    speed limit control algorithm based on shock wave theory", IEEE ITSC 2008. The rule is our own.
    """

    def choose(self, view: LimitView) -> NDArray[np.int64]:
        """Return the lowest allowed choice, or the next higher choice."""
        names = view.table.sections
        section = names.index(view.config.watched) if view.config.watched else len(names) - 1
        column = len(view.table.speeds_mps) + section * OF_SECTION
        per_km = view.observations[..., column] * DENSITY_SCALE
        lowest = view.masks.argmax(axis=-1)
        higher = np.minimum(view.states[..., GREEN] + 1, len(view.table.speeds_mps) - 1)
        found = np.where(per_km > view.config.wanted_per_km, lowest, higher)
        return np.where(view.decides[:, None], found, KEEP)


def make_limit_controller(name: str) -> LimitController:
    """Return the controller with this name in `LIMIT_CONTROLLERS`."""
    if name != "feedback":
        raise ConfigError(f"limits.controller = {name!r}: must be feedback, or agents")
    return Feedback()
