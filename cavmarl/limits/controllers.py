"""Controllers of speed limits: they choose from what agents know of the sections."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.limits import LimitsConfig
from cavmarl.core.errors import ConfigError
from cavmarl.limits.kernels.limit_steps import DENSITY_SCALE, OF_SECTION
from cavmarl.limits.limit_table import LimitTable
from cavmarl.signals.kernels.green_choices import GREEN, KEEP

BAND = 0.1  # share of the wanted density within which `feedback` keeps its choice


class LimitView(NamedTuple):
    """What controllers know, in W worlds.

    Attributes:
        config: speeds and kind of action.
        table: the U units and their sections.
        observations: (W, U, D) as agents get them.
        ticks: (W,) since the reset.
        states: (W, U, HELD) of the units; see `LimitOutputs`.
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
    """Lowers the limits by one place above the wanted density, and raises them below it.

    This is ALINEA's integral feedback for speed limits instead of ramps, in steps.

    Sources: Papageorgiou, Hadj-Salem, Blosseville, "ALINEA: a local feedback control law for
    on-ramp metering" (1991); Carlson, Papamichail, Papageorgiou, "Local feedback-based mainstream
    traffic flow control on motorways using variable speed limits" (2011).
    """

    def choose(self, view: LimitView) -> NDArray[np.int64]:
        """Return the present choice, one place lower or one place higher."""
        names = view.table.sections
        section = names.index(view.config.watched) if view.config.watched else len(names) - 1
        column = len(view.table.speeds_mps) + section * OF_SECTION
        per_km = view.observations[..., column] * DENSITY_SCALE
        wanted = view.config.wanted_per_km
        step = (per_km < (1.0 - BAND) * wanted).astype(np.int64) - (per_km > (1.0 + BAND) * wanted)
        most = len(view.table.speeds_mps) - 1
        found = np.clip(view.states[..., GREEN] + step, 0, most)
        return np.where(view.decides[:, None], found, KEEP)


def make_limit_controller(name: str) -> LimitController:
    """Return the controller of a name of `LIMIT_CONTROLLERS`."""
    if name != "feedback":
        raise ConfigError(f"limits.controller = {name!r}: must be feedback, or agents")
    return Feedback()
