"""Signals that show the caller's states, and their part of a tick."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ActionError
from cavmarl.engine.component import Component, ComponentContext
from cavmarl.roads.network import SIGNAL_STATES
from cavmarl.shards.shard import Commands


class OverrideComponent(Component):
    """Writes the caller's states to `Worlds.signal_phase`.

    All processes of a world write the same states.
    """

    def __init__(self, host: ComponentContext) -> None:
        worlds = host.shards[0].worlds
        self._has_signal = host.network.links["signal"] >= 0
        self._shown = worlds.signal_phase[:, len(host.network.signals) :]  # (W, num_links)
        self._ticks = worlds.ticks
        self._ticks_per_step = host.config.clock.ticks_per_step

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Let the programs of the chosen worlds (W,) control all signals."""
        self._shown[chosen] = 0

    def begin(self, commands: Commands) -> None:
        """Take the states of a step in its first tick."""
        told = commands.overridden
        if not told.size or self._ticks.item(0) % self._ticks_per_step:
            return
        if wrong := wrong_states(told, self._has_signal):
            raise ActionError(wrong)
        self._shown[:] = 0
        worlds, places = np.nonzero(told[..., 1])
        self._shown[worlds, told[worlds, places, 0]] = told[worlds, places, 1]


def wrong_states(told: NDArray[np.int32], has_signal: NDArray[np.bool_]) -> str:
    """Return what is wrong with the caller's states; empty if they are valid.

    `told`: (W, N, 2) see `Commands.overridden`. `has_signal`: (num_links,).
    """
    link, state = told[told[..., 1] != 0].T
    if ((state < 0) | (state > len(SIGNAL_STATES))).any():
        return "a signal shows an unknown state"
    if ((link < 0) | (link >= len(has_signal))).any() or not has_signal[link].all():
        return "a link without a signal shows a state"
    return ""
