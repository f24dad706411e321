"""`SignalAgents`: the agents of signals, with their spaces, and the check of their choices."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.signals import SIGNAL_TERMS
from cavmarl.core.errors import ActionError
from cavmarl.parallel.worlds.step_arrays import StepArrays
from cavmarl.roads.network import RoadNetwork
from cavmarl.signals.controllers import ProgramController, SignalView
from cavmarl.signals.kernels.green_choices import GREEN, KEEP, REFUSED
from cavmarl.signals.signal_table import SignalTable

PREFIX = "signal_"  # of the ids of these agents, followed by the id of the signal

# The kinds of agents: keys of the arrays of an environment in which signals have agents.
VEHICLES, SIGNALS = "vehicles", "signals"


class SignalAgents:
    """The agents of S signals in W worlds, and their results.

    Args:
        config: configuration of the worlds.
        network: map of the worlds.
        arrays: inputs and outputs of a step.

    Attributes:
        table: the signals with their greens, lanes and movements.
        agents: ids of the agents (S,).
    """

    def __init__(self, config: EnvConfig, network: RoadNetwork, arrays: StepArrays) -> None:
        self._config = config.signals
        self._dt = config.clock.sim_dt_s
        self._is_strict = config.action.missing_action == "error"
        self._arrays = arrays
        self.table = SignalTable(network, self._config.range_m)
        self.agents = tuple(f"{PREFIX}{name}" for name in self.table.ids)
        self._index = {agent: s for s, agent in enumerate(self.agents)}
        cyclic = self._config.action == "keep_or_next"
        greens = self.table.arrays.num_greens
        self.num_choices: NDArray[np.int32] = np.minimum(greens, 2) if cyclic else greens
        self._keep = np.full(arrays.signal_choices.shape, KEEP, dtype=np.int64)

    def __contains__(self, agent: object) -> bool:
        return agent in self._index

    @property
    def view(self) -> SignalView:
        """The state for controllers; see `signals.controllers`."""
        arrays = self._arrays
        return SignalView(
            config=self._config,
            dt=self._dt,
            table=self.table,
            observations=arrays.signal_observations,
            ticks=arrays.ticks,
            counts=arrays.signal_counts,
            states=arrays.signal_states,
            masks=arrays.signal_masks,
            decides=arrays.signal_decides,
            history=arrays.signal_history,
            loops=arrays.signal_loops,
        )

    def suggest(self) -> NDArray[np.int64]:
        """Return the choices (W, S) that follow the durations of the map's programs."""
        return ProgramController().choose(self.view)

    def observation_spaces(self) -> dict[str, spaces.Space[Any]]:
        """Return the space of each agent's observation: a Box of its own size."""
        return {
            agent: spaces.Box(0.0, 1.0, (size,), np.float32)
            for agent, size in zip(self.agents, self.table.features, strict=True)
        }

    def action_spaces(self) -> dict[str, spaces.Space[Any]]:
        """Return the space of each agent's choices."""
        return {
            agent: spaces.Discrete(count)
            for agent, count in zip(self.agents, self.num_choices.tolist(), strict=True)
        }

    @property
    def most_choices(self) -> int:
        """The number of choices G of the signal with most choices."""
        return int(self.num_choices.max())

    @property
    def padded_observation_space(self) -> spaces.Box:
        """The space of each observation (D,), padded with 0 to the longest one."""
        return spaces.Box(0.0, 1.0, (self.table.sizes.features,), np.float32)

    def keep_beyond(self, choices: NDArray[Any]) -> NDArray[np.int64]:
        """Return choices (W, S); a choice beyond a signal's greens keeps its green.

        For policies that choose among `most_choices` for every signal.
        """
        keep = (
            self._arrays.signal_states[..., GREEN]
            if self._config.action == "next_phase"
            else np.zeros(choices.shape, dtype=np.int64)
        )
        return np.where(choices < self.num_choices, choices, keep)

    def check(self, agent: str, action: Any) -> None:
        """Raise the ActionError of an action that is no choice of the agent's signal."""
        s = self._index[agent]
        if np.shape(action) != () or np.asarray(action).dtype.kind not in "iu":
            raise ActionError(f"{agent}: the action is {action!r}, must be one whole number")
        if not 0 <= action < self.num_choices[s]:
            raise ActionError(
                f"{agent}: the action is {action}, must be from 0 to {self.num_choices[s] - 1}"
            )

    def from_dict(self, actions: Mapping[str, Any]) -> NDArray[np.int64]:
        """Return the choices (1, S) of one world's agents.

        Raises:
            ActionError: an action is missing or invalid.
        """
        if not self._arrays.signal_decides[0]:
            return self._keep
        missing = [agent for agent in self.agents if agent not in actions]
        if missing and self._is_strict:
            raise ActionError(
                f"no action for {', '.join(missing)}: pass one for each signal when "
                "infos[id]['decides'] is 1, or set action.missing_action = hold"
            )
        for agent in filter(actions.__contains__, self.agents):
            self.check(agent, actions[agent])
        return self._allowed(np.array([[actions.get(agent, KEEP) for agent in self.agents]]))

    def from_array(self, choices: Any) -> NDArray[np.int64]:
        """Return the choices (W, S) of all worlds.

        Raises:
            ActionError: the shape, the dtype or a value is wrong.
        """
        found = np.asarray(choices)
        if found.shape != self._keep.shape:
            raise ActionError(
                f"choices of signals have shape {found.shape}: must be {self._keep.shape}, "
                "(num_envs, number of signals)"
            )
        if found.dtype.kind not in "iu":
            raise ActionError(
                f"choices of signals have dtype {found.dtype}: pass whole numbers (int64)"
            )
        reads = np.broadcast_to(self._arrays.signal_decides[:, None], found.shape)
        wrong = reads & ((found < 0) | (found >= self.num_choices))
        if wrong.any():
            w, s = np.argwhere(wrong)[0].tolist()
            raise ActionError(
                f"world {w}, {self.agents[s]}: the action is {found[w, s]}, must be from 0 to "
                f"{self.num_choices[s] - 1}"
            )
        return self._allowed(np.where(reads, found, KEEP))

    def _allowed(self, choices: NDArray[Any]) -> NDArray[np.int64]:
        """Return choices; with `forbidden: error`, raise an ActionError for an excluded choice."""
        found = choices.astype(np.int64)
        if self._config.forbidden == "error":
            index = np.maximum(found, 0)[..., None]
            may = np.take_along_axis(self._arrays.signal_masks, index, axis=2)[..., 0]
            wrong = (found != KEEP) & ~may
            if wrong.any():
                w, s = np.argwhere(wrong)[0].tolist()
                raise ActionError(
                    f"world {w}, {self.agents[s]}: the action {found[w, s]} is not allowed now; "
                    "choose one of the action mask, or set signals.forbidden = ignore"
                )
        return found

    def infos(self) -> dict[str, dict[str, Any]]:
        """Return the info of each agent of the first world.

        `decides`: whether its next action counts. `action_mask`: allowed choices, int8. `green`:
        index of the present green. `refused`: choices of the episode that were not allowed. And
        each term of the reward.
        """
        arrays = self._arrays
        decides = int(arrays.signal_decides[0])
        masks = arrays.signal_masks[0].astype(np.int8)
        states = arrays.signal_states[0].tolist()
        found: dict[str, dict[str, Any]] = {}
        for s, (agent, terms) in enumerate(
            zip(self.agents, arrays.signal_terms[0].tolist(), strict=True)
        ):
            found[agent] = {
                **dict(zip(SIGNAL_TERMS, terms, strict=True)),
                "decides": decides,
                "action_mask": masks[s, : self.num_choices[s]],
                "green": states[s][GREEN],
                "refused": states[s][REFUSED],
            }
        return found

    def observations(self) -> dict[str, NDArray[np.float32]]:
        """Return a copy of each agent's observation in the first world."""
        found = self._arrays.signal_observations[0].copy()
        return {
            agent: found[s, :size]
            for s, (agent, size) in enumerate(zip(self.agents, self.table.features, strict=True))
        }
