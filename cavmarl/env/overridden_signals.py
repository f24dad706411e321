"""`SignalOverrides`: signals that show the caller's states instead of their programs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ActionError, CapacityError, ConfigError
from cavmarl.core.records.codes import SIGNAL_NONE
from cavmarl.engine.override_component import wrong_states
from cavmarl.engine.simulation import Simulation
from cavmarl.roads.network import SIGNAL_STATES, RoadNetwork
from cavmarl.roads.shown_signals import signal_codes
from cavmarl.shards.shard import Commands


class SignalOverrides:
    """The links in W worlds whose signals show states of the caller.

    At most N = `signals.overrides` links of a world can do so at the same time. Drivers, sensors,
    messages and drawings see these states like states of a program. The programs continue to run.

    Args:
        config: configuration of the worlds.
        network: map of the worlds.
        num_worlds: number of worlds, W.
        present: returns the worlds as they are now.
    """

    def __init__(
        self,
        config: EnvConfig,
        network: RoadNetwork,
        num_worlds: int,
        present: Callable[[], Simulation],
    ) -> None:
        self._most = config.signals.overrides
        self._network = network
        self._present = present
        self._told = np.zeros((num_worlds, self._most, 2), dtype=np.int32)  # `Commands.overridden`

    @property
    def memory(self) -> tuple[NDArray[Any], ...]:
        """The states that the caller shows from the next step on."""
        return (self._told,)

    @memory.setter
    def memory(self, memory: tuple[NDArray[Any], ...]) -> None:
        (self._told[:],) = memory

    def wrong(self, memory: Sequence[NDArray[Any]]) -> str:
        """Return what is wrong with a loaded `memory`; empty if it is valid."""
        return wrong_states(memory[0], self._network.links["signal"] >= 0)

    def show(self, signal: str, index: int, letter: str, world: int = 0) -> None:
        """Show a letter at a signal, from the next step on until `release` or a reset.

        Args:
            signal: id of the signal.
            index: position in the letters of the signal's phases; all links there show the letter.
            letter: one of `rugGysoOY`, SUMO's letters.
            world: number of the world.

        Raises:
            ActionError: there is no such signal, link or letter.
            CapacityError: the world already has `signals.overrides` such links.
            ConfigError: `signals.overrides` is 0.
        """
        links = self._links(world, signal, index)
        if len(letter) != 1 or letter not in SIGNAL_STATES:
            raise ActionError(f"letter = {letter!r}: must be one of {SIGNAL_STATES}")
        told = self._told[world]
        is_used = told[:, 1] > 0
        others = is_used & ~np.isin(told[:, 0], links)
        if np.count_nonzero(others) + len(links) > self._most:
            raise self._full(world)
        kept = told[others]
        told[:] = 0
        told[: len(kept)] = kept
        told[len(kept) : len(kept) + len(links), 0] = links
        told[len(kept) : len(kept) + len(links), 1] = 1 + SIGNAL_STATES.index(letter)

    def release(self, signal: str, index: int | None = None, world: int = 0) -> None:
        """Let a signal show the letters of its program again, from the next step on.

        Args:
            signal: id of the signal.
            index: see `show`; None: all links of the signal.
            world: number of the world.

        Raises:
            ActionError: there is no such signal or link.
            ConfigError: `signals.overrides` is 0.
        """
        links = self._links(world, signal, index)
        told = self._told[world]
        told[np.isin(told[:, 0], links)] = 0

    def show_links(self, codes: NDArray[np.uint8], world: int = 0) -> None:
        """Show these states from the next step on, and release all other links.

        Args:
            codes: (num_links,) SIGNAL_* code of each link; SIGNAL_NONE: the code of its program.
            world: number of the world.

        Raises:
            ActionError: a link without a signal has a code, or a code is invalid.
            CapacityError, ConfigError: see `show`.
        """
        self._check_world(world)
        links = np.flatnonzero(codes != SIGNAL_NONE)
        if len(links) > self._most:
            raise self._full(world)
        told = np.zeros_like(self._told[world])
        told[: len(links), 0] = links
        told[: len(links), 1] = codes[links].astype(np.int32) + 1
        if wrong := wrong_states(told, self._network.links["signal"] >= 0):
            raise ActionError(f"codes: {wrong}")
        self._told[world] = told

    def letters(self, signal: str, world: int = 0) -> str:
        """Return the letters that a signal shows now, by index; `-`: no link has the index.

        Raises:
            ActionError: there is no such signal.
            ConfigError: `signals.overrides` is 0.
        """
        links = self._links(world, signal, None)
        codes = signal_codes(self._network, self._present().signal_phases(world))
        row = self._network.links["signal"][links[0]]
        letters = ["-"] * int(self._network.signals["num_links"][row])
        for link in links.tolist():
            letters[self._network.links["signal_index"][link]] = SIGNAL_STATES[codes[link]]
        return "".join(letters)

    def add_to(self, commands: Commands) -> Commands:
        """Return the commands with the states of the caller."""
        return replace(commands, overridden=self._told.copy()) if self._most else commands

    def clear(self) -> None:
        """Do nothing: the states stay."""

    def forget(self, chosen: NDArray[np.bool_]) -> None:
        """Begin an episode in the chosen worlds (W,)."""
        self._told[chosen] = 0

    def _check_world(self, world: int) -> None:
        if not self._most:
            raise ConfigError(
                "these worlds do not let the caller control signals: set signals.overrides to the "
                "number of links that you want to control at the same time"
            )
        if not 0 <= world < len(self._told):
            raise ActionError(f"world {world}: must be from 0 to {len(self._told) - 1}")

    def _full(self, world: int) -> CapacityError:
        return CapacityError(
            f"world {world}: signals.overrides = {self._most} links show states of the caller "
            "already; set it higher, or release a signal"
        )

    def _links(self, world: int, signal: str, index: int | None) -> NDArray[np.intp]:
        """Return the LINK rows of a signal, or of one of its indices."""
        self._check_world(world)
        network = self._network
        if signal not in network.signal_ids:
            known = ", ".join(network.signal_ids[:8]) or "no signals"
            raise ActionError(f"signal {signal!r}: there is no such signal; the map has {known}")
        own = network.links["signal"] == network.signal_ids.index(signal)
        indices = sorted(set(network.links["signal_index"][own].tolist()))
        if index is None:
            return np.flatnonzero(own)
        if index not in indices:
            raise ActionError(
                f"signal {signal!r}, index {index}: no link has this index; must be one of "
                f"{', '.join(map(str, indices))}"
            )
        return np.flatnonzero(own & (network.links["signal_index"] == index))
