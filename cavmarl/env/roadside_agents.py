"""`RoadsideAgents`: agents of signals or of speed limits, with their spaces and checks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from cavmarl.core.errors import ActionError
from cavmarl.parallel.worlds.step_arrays import StepArrays
from cavmarl.signals.kernels.green_choices import GREEN, KEEP, REFUSED

VEHICLES = "vehicles"  # key of the vehicles' arrays; other keys are `RoadsideAgents.kind`


class RoadsideAgents(ABC):
    """S agents of one kind in W worlds, and their results.

    All agents decide at the same times. Their arrays in `StepArrays` begin with `signal_`,
    whatever their kind: a world has agents of signals or of limits.

    Args:
        arrays: inputs and outputs of a step.
        names: names of the places that the agents control.
        num_choices: (S,) choices of each agent.
        features: (S,) length of each agent's observation.
        is_strict: whether a missing action is an error.
        forbids: whether a choice that the mask excludes is an error.

    Attributes:
        agents: ids of the agents (S,).
        num_choices: as above.
    """

    kind: ClassVar[str]  # key of the arrays of an environment, and section of the configuration
    prefix: ClassVar[str]  # prefix of these agents' ids, followed by the name
    terms: ClassVar[tuple[str, ...]]  # terms of the reward
    choice: ClassVar[str]  # name of the current choice in infos

    def __init__(
        self,
        arrays: StepArrays,
        names: Sequence[str],
        num_choices: NDArray[np.int32],
        features: Sequence[int],
        *,
        is_strict: bool,
        forbids: bool,
    ) -> None:
        self._arrays = arrays
        self._is_strict, self._forbids = is_strict, forbids
        self.agents = tuple(f"{self.prefix}{name}" for name in names)
        self._index = {agent: s for s, agent in enumerate(self.agents)}
        self.num_choices = num_choices
        self._sizes = tuple(features)
        self._keep = np.full(arrays.signal_choices.shape, KEEP, dtype=np.int64)

    def __contains__(self, agent: object) -> bool:
        return agent in self._index

    @property
    @abstractmethod
    def view(self) -> Any:
        """What controllers know; it has `observations`, `states`, `masks` and `decides`."""

    @abstractmethod
    def suggest(self) -> NDArray[np.int64]:
        """Return the default choices (W, S), as without agents; KEEP where no decision is due."""

    @abstractmethod
    def kept(self) -> NDArray[np.int64]:
        """Return the choices (W, S) that change nothing."""

    def observation_spaces(self) -> dict[str, spaces.Space[Any]]:
        """Return the space of each agent's observation: a Box of its own size."""
        return {
            agent: spaces.Box(0.0, 1.0, (size,), np.float32)
            for agent, size in zip(self.agents, self._sizes, strict=True)
        }

    def action_spaces(self) -> dict[str, spaces.Space[Any]]:
        """Return the space of each agent's choices."""
        return {
            agent: spaces.Discrete(count)
            for agent, count in zip(self.agents, self.num_choices.tolist(), strict=True)
        }

    @property
    def most_choices(self) -> int:
        """The number of choices G of the agent with most choices."""
        return int(self.num_choices.max())

    @property
    def padded_observation_space(self) -> spaces.Box:
        """The space of each observation (D,), padded with 0 to the longest one."""
        return spaces.Box(0.0, 1.0, (max(self._sizes),), np.float32)

    def keep_beyond(self, choices: NDArray[Any]) -> NDArray[np.int64]:
        """Return choices (W, S); a choice that an agent does not have changes nothing.

        For policies that choose among `most_choices` for every agent.
        """
        return np.where(choices < self.num_choices, choices, self.kept())

    def check(self, agent: str, action: Any) -> None:
        """Raise the ActionError of an action that is not a choice of the agent."""
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
                f"no action for {', '.join(missing)}: pass one for each of {self.kind} when "
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
                f"choices of {self.kind} have shape {found.shape}: must be {self._keep.shape}, "
                f"(num_envs, number of {self.kind})"
            )
        if found.dtype.kind not in "iu":
            raise ActionError(
                f"choices of {self.kind} have dtype {found.dtype}: pass whole numbers (int64)"
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
        if self._forbids:
            index = np.maximum(found, 0)[..., None]
            may = np.take_along_axis(self._arrays.signal_masks, index, axis=2)[..., 0]
            wrong = (found != KEEP) & ~may
            if wrong.any():
                w, s = np.argwhere(wrong)[0].tolist()
                raise ActionError(
                    f"world {w}, {self.agents[s]}: the action {found[w, s]} is not allowed now; "
                    f"choose one of the action mask, or set {self.kind}.forbidden = ignore"
                )
        return found

    def infos(self) -> dict[str, dict[str, Any]]:
        """Return the info of each agent of the first world.

        `decides`: whether its next action counts. `action_mask`: allowed choices, int8. `refused`:
        number of choices in the episode that were not allowed. The attribute `choice` is the
        key of the index of the present choice; each term of the reward has its own key.
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
                **dict(zip(self.terms, terms, strict=True)),
                "decides": decides,
                "action_mask": masks[s, : self.num_choices[s]],
                self.choice: states[s][GREEN],
                "refused": states[s][REFUSED],
            }
        return found

    def infos_of_worlds(self) -> dict[str, NDArray[Any]]:
        """Return the infos of a `CavVectorEnv`; their keys begin with `signal_` or `limit_`."""
        arrays, name = self._arrays, self.prefix
        return {
            f"{name}mask": arrays.signal_masks.copy(),
            f"{name}decides": arrays.signal_decides.copy(),
            f"{name}terms": arrays.signal_terms.copy(),
            f"{name}refused": arrays.signal_states[..., REFUSED].copy(),
        }

    def observations(self) -> dict[str, NDArray[np.float32]]:
        """Return a copy of each agent's observation in the first world."""
        found = self._arrays.signal_observations[0].copy()
        return {
            agent: found[s, :size]
            for s, (agent, size) in enumerate(zip(self.agents, self._sizes, strict=True))
        }
