"""Rows of the step arrays as dicts: from agent to observation, and from agent to info."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.engine.spaces import named_observation, observation_parts, sensed_observation
from cavmarl.parallel.worlds.step_arrays import StepArrays

Observation = NDArray[np.float32] | dict[str, NDArray[Any]]
Listed = NDArray[np.intp] | slice
"""Rows of an array that belong to the agents in the episode."""

# Keys of an agent's info that follow the keys of the reward terms.
_OF_VEHICLE = ("active", "vehicle_done", "vehicle_id")


class AgentDicts:
    """Makes the dicts of one world that PettingZoo's API returns.

    Args:
        config: configuration of the world.
    """

    def __init__(self, config: EnvConfig) -> None:
        form = config.observation
        self._senses = form.mode == "sensors" and form.kind == "dict"
        population = config.population
        self._carriers = (
            {name: population.carriers(name) for name in config.rig} if population.fleet else None
        )
        self._parts = (
            observation_parts(config.sensors)
            if form.kind == "dict" and form.mode != "sensors"
            else None
        )
        self._stack = config.sensors.stack
        self._term_names = config.terms.names
        self._absent = dict.fromkeys((*self._term_names, *_OF_VEHICLE), 0.0)
        self._active = self._absent | {"active": 1.0}

    def observations(
        self, arrays: StepArrays, agents: list[str], listed: Listed
    ) -> dict[str, Observation]:
        """Return a copy of each agent's observation."""
        if self._senses:
            sensed = {
                name: data[0, listed].copy()
                for name, data in sensed_observation(arrays.frames).items()
            }
            if self._carriers is None:
                return {
                    agent: {name: data[k] for name, data in sensed.items()}
                    for k, agent in enumerate(agents)
                }
            carried = {name: carriers[listed] for name, carriers in self._carriers.items()}
            return {
                agent: {name: data[k] for name, data in sensed.items() if carried[name][k]}
                for k, agent in enumerate(agents)
            }
        found = arrays.observations[0].copy()[listed]
        if self._parts is None:
            return dict(zip(agents, found, strict=True))
        named = named_observation(
            self._parts, found.reshape(len(found), self._stack, found.shape[1] // self._stack)
        )
        return {
            agent: {name: part[k] for name, part in named.items()} for k, agent in enumerate(agents)
        }

    def infos(
        self, arrays: StepArrays, agents: list[str], listed: Listed
    ) -> dict[str, dict[str, float]]:
        """Return the info of each agent: every term, and the state of its vehicle."""
        done, ids = arrays.vehicle_done[0, listed], arrays.vehicle_ids[0, listed]
        active = (ids >= 0) & ~done
        terms = arrays.terms[0, listed].T
        # Most terms are 0 for all agents: no accident, no red light.
        columns = [
            (self._term_names[k], terms[k]) for k in np.flatnonzero(terms.any(axis=1)).tolist()
        ]
        columns.append(("vehicle_id", ids))
        usual = self._active
        if not active.all():
            usual = self._absent
            columns.append(("active", active.astype(np.float64)))
            columns.append(("vehicle_done", done.astype(np.float64)))
        infos = [usual.copy() for _ in agents]
        for name, column in columns:
            for info, number in zip(infos, column.tolist(), strict=True):
                info[name] = number
        return dict(zip(agents, infos, strict=True))
