"""Events that agents want to announce by message, kept until the next step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ActionError, ConfigError
from cavmarl.shards.shard import Commands
from cavmarl.v2x.v2x_messages import CAUSES, cause_code


class DeclaredEvents:
    """At most one event per agent and step; a later event replaces an earlier one."""

    def __init__(self, config: EnvConfig, num_worlds: int) -> None:
        self._enabled = config.v2x.enabled
        self._causes = np.zeros((num_worlds, config.population.num_ids), dtype=np.int32)
        self._has_any = False

    @property
    def memory(self) -> NDArray[np.int32]:
        """(W, A) codes of the events that are declared for the next step."""
        return self._causes

    @memory.setter
    def memory(self, causes: NDArray[np.int32]) -> None:
        self._causes[:] = causes
        self._has_any = bool(causes.any())

    def wrong(self, causes: NDArray[np.int32]) -> str:
        """Return what is wrong with the `memory` of a saved state; an empty text if it is valid."""
        if not self._enabled and causes.any():
            return "events are declared in worlds without messages"
        return wrong_causes(causes)

    def declare(self, world: int, agent: int, cause: str) -> None:
        if not self._enabled:
            raise ConfigError("no messages are sent in this world: set v2x.enabled to true")
        num_worlds, num_agents = self._causes.shape
        if not (0 <= world < num_worlds and 0 <= agent < num_agents):
            raise ActionError(
                f"agent {agent} of world {world}: there are {num_agents} agents in each of "
                f"{num_worlds} worlds"
            )
        self._causes[world, agent] = cause_code(cause)
        self._has_any = True

    def add_to(self, commands: Commands) -> Commands:
        """Return the commands with the declared events, which are kept until `clear`."""
        return replace(commands, declared=self._causes.copy()) if self._has_any else commands

    def forget(self, chosen: NDArray[np.bool_]) -> None:
        """Drop the declared events of the chosen worlds (W,), whose episode ends."""
        self._causes[chosen] = 0
        self._has_any = bool(self._causes.any())

    def clear(self) -> None:
        """Drop the declared events after the step that sent them."""
        if self._has_any:
            self._causes[:] = 0
            self._has_any = False


def wrong_causes(causes: NDArray[np.int32]) -> str:
    """Return an error if a code is neither 0 nor a CAUSE_* code; otherwise an empty text."""
    is_known = np.isin(causes, (0, *CAUSES.values())).all()
    return "" if is_known else "an event has an unknown code"
