"""W worlds with their agents as an `EnvBase` of TorchRL: one batch of tensors.

Steps have no Python loop over agents. Importing this module loads TorchRL and torch;
`import cavmarl` does not import it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from cavmarl.adapters.observations import ObservationForm, refuse_decided
from cavmarl.core.errors import missing
from cavmarl.core.seeds import check_seed
from cavmarl.env.roadside_agents import VEHICLES, RoadsideAgents
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.env.world_copies import OwnWorlds

try:
    import torch
    from tensordict import TensorDict, TensorDictBase
    from torch import Tensor
    from torchrl.data import Bounded, Categorical, Composite, TensorSpec, Unbounded
    from torchrl.envs import EnvBase
except ModuleNotFoundError as error:
    raise missing(error.name, "torchrl") from error

ENDS = ("done", "terminated", "truncated")
DECIDED = ("autoreset_mode", "copy")  # TorchRL resets worlds itself and keeps its inputs


class CavTorchRLEnv(OwnWorlds, EnvBase):  # type: ignore[misc] # TorchRL is not typed
    """W worlds of the batch size (W,), with A agents of vehicles and S agents of signals each.

    The groups are `vehicles` and `signals`; a kind without agents has no group. Agents of speed
    limits have the group `limits`, which is like the group of signals. Entries of a
    tensordict; the entries of a group have one axis more than the batch:

    - `("vehicles", "observation")`: (W, A, D), or one entry per sensor (`observation.kind: dict`);
    - `("vehicles", "mask")`: (W, A) whether an agent has a vehicle and acts next. Actions of other
      agents are not read. Their observations are 0, except for the last observation of an agent
      that has just ended. Use only entries where the mask is True for losses and means;
    - `("vehicles", "action")`: (W, A, 2) within [-1, 1], or (W, A) meta-actions;
    - `("next", "vehicles", "reward")`: (W, A, 1);
    - `("next", "vehicles", "terminated")`, `"truncated"`, `"done"`: (W, A, 1) whether the agent's
      trip ended, or the horizon ended it. Use these for value estimators;
    - `("next", "vehicles", "info", term)`: (W, A, 1) each term by its name.

    The group `signals` has the same entries with these differences:

    - `("signals", "observation")`: (W, S, D) padded with 0 to the longest observation;
    - `("signals", "mask")`: (W, S) whether a decision is due. In other steps, actions are
      not read, and rewards are 0;
    - `("signals", "action")`: (W, S) choices from 0 to G - 1, where G is the largest number of
      choices. A choice that a signal does not have keeps its green;
    - `("signals", "action_mask")`: (W, S, G) choices that are allowed now. At least one is allowed.
      TorchRL's `ActionMask` and `MaskedCategorical` use it.

    If vehicles choose meta-actions beside signals, `vehicles` has an `action_mask` (W, A, n), too:
    it allows every action. BenchMARL needs masks of all groups or of none.

    `("next", "terminated")`, `"truncated"`, `"done"` (W, 1) refer to each world; TorchRL resets
    worlds that are done. Observations of that step are still the last ones of the old episode.

    Every population can be used; the mask changes when agents enter and leave. In `respawn` worlds,
    an agent that is done gets another vehicle while its world continues.

    Args:
        env: see `make_vec`.
        num_envs: W.
        device: device of the tensors; the worlds stay on the CPU.
        arguments: other keyword arguments of `make_vec`.

    Raises:
        ConfigError: a key, a value or a combination is not possible.
    """

    batch_locked = True

    def __init__(
        self,
        env: str | Path = "merge",
        *,
        num_envs: int = 1,
        device: torch.device | str | None = None,
        **arguments: Any,
    ) -> None:
        refuse_decided(DECIDED, arguments)
        # Keep last observations, and do not reset a world again that TorchRL has reset.
        vec = make_vec(env, num_envs=num_envs, autoreset_mode=AutoresetMode.NEXT_STEP, **arguments)
        super().__init__(device=device, batch_size=[num_envs])
        self._vec = vec
        self._next_seed: int | None = None
        self.max_cycles = vec.max_cycles
        self._roadside = vec.roadside
        self._groups: dict[str, _Group] = {}
        if vec.config.population.agents:
            self._form = ObservationForm(vec.config)
            self._groups[VEHICLES] = _vehicles(vec, self._form.space)
        if self._roadside is not None:
            self._groups[self._roadside.kind] = _of_roadside(vec, self._roadside)
        self.group_map = {group: list(each.ids) for group, each in self._groups.items()}
        of_group: dict[str, dict[str, Composite]] = {}
        for group, each in self._groups.items():
            shape = (num_envs, len(each.ids))
            terms = Composite({name: Unbounded((*shape, 1)) for name in each.terms}, shape=shape)
            entries = {
                "observation": {**each.observation, "mask": _flags(shape), "info": terms},
                "action": {"action": each.action},
                "reward": {"reward": Unbounded((*shape, 1))},
                "done": {name: _flags((*shape, 1)) for name in ENDS},
            }
            for kind, specs in entries.items():
                of_group.setdefault(kind, {})[group] = Composite(specs, shape=shape)
        specs_of = {kind: Composite(each, shape=[num_envs]) for kind, each in of_group.items()}
        specs_of["done"].update({name: _flags((num_envs, 1)) for name in ENDS})
        self.observation_spec, self.action_spec = specs_of["observation"], specs_of["action"]
        self.reward_spec, self.done_spec = specs_of["reward"], specs_of["done"]

    @property
    def vec(self) -> CavVectorEnv:
        """The worlds behind this view."""
        return self._vec

    def _set_seed(self, seed: int | None) -> None:
        self._next_seed = None if seed is None else check_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        chosen = None if tensordict is None else tensordict.get("_reset", None)
        if chosen is None or chosen.all():
            observations, infos = self._vec.reset(seed=self._next_seed)
            self._next_seed = None
        else:
            mask = chosen.reshape(-1).cpu().numpy()
            observations, infos = self._vec.reset(options={"reset_mask": mask})
        none, no_terms = {}, {}
        for group, each in self._groups.items():
            agents = (*self.batch_size, len(each.ids))
            none[group] = np.zeros(agents, dtype=np.bool_)
            no_terms[group] = np.zeros((*agents, len(each.terms)), dtype=np.float32)
        entries = self._entries(self._by_group(observations), none, none, no_terms, infos)
        everywhere = np.zeros(len(infos["mask"]), dtype=np.bool_)
        return self._tensors(entries, _ends(everywhere, everywhere))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        actions: Any = {
            group: tensordict.get((group, "action")).cpu().numpy() for group in self.group_map
        }
        if self._roadside is not None:
            kind = self._roadside.kind
            actions[kind] = self._roadside.keep_beyond(actions[kind])
        else:
            actions = actions[VEHICLES]
        *results, infos = self._vec.step(actions)
        observations, rewards, ended, cut = map(self._by_group, results)
        terms = {VEHICLES: infos["terms"]}
        if self._roadside is not None:
            terms[self._roadside.kind] = infos[f"{self._roadside.prefix}terms"]
        entries = self._entries(observations, ended, cut, terms, infos)
        for group, found in entries.items():
            found["reward"] = torch.from_numpy(rewards[group]).unsqueeze(-1)
        over = infos["episode_over"]
        at_horizon = np.any([cut[group].any(axis=1) for group in self.group_map], axis=0)
        return self._tensors(entries, _ends(over & ~at_horizon, over & at_horizon))

    def _by_group(self, result: Any) -> Mapping[str, NDArray[Any]]:
        """Return a result of the worlds by the kind of agents."""
        return {VEHICLES: result} if self._roadside is None else result

    def _entries(
        self,
        observations: Mapping[str, NDArray[np.float32]],
        ended: Mapping[str, NDArray[np.bool_]],
        cut: Mapping[str, NDArray[np.bool_]],
        terms: Mapping[str, NDArray[np.float32]],
        infos: Mapping[str, NDArray[Any]],
    ) -> dict[str, dict[str, Any]]:
        """Return the entries of each group without rewards; arrays are not copied."""
        found: dict[str, dict[str, Any]] = {}
        for group, each in self._groups.items():
            columns = torch.from_numpy(terms[group])
            found[group] = _ends(ended[group], cut[group]) | {
                "info": {term: columns[..., k : k + 1] for k, term in enumerate(each.terms)}
            }
        if VEHICLES in found:
            shown = self._form(observations[VEHICLES])
            found[VEHICLES] |= {
                "observation": torch.from_numpy(shown)
                if isinstance(shown, np.ndarray)
                else {name: torch.from_numpy(part) for name, part in shown.items()},
                "mask": torch.from_numpy(infos["mask"]),
            }
            mask = self._groups[VEHICLES].observation.get("action_mask")
            if mask is not None:
                found[VEHICLES]["action_mask"] = torch.ones(mask.shape, dtype=torch.bool)
        if self._roadside is not None:
            kind, prefix = self._roadside.kind, self._roadside.prefix
            decides = torch.from_numpy(infos[f"{prefix}decides"])
            found[kind] |= {
                "observation": torch.from_numpy(observations[kind]),
                "mask": decides.unsqueeze(-1).repeat(1, len(self.group_map[kind])),
                "action_mask": torch.from_numpy(infos[f"{prefix}mask"]),
            }
        return found

    def _tensors(
        self, entries: Mapping[str, Mapping[str, Any]], worlds: Mapping[str, Tensor]
    ) -> TensorDict:
        groups = {
            group: TensorDict(found, (*self.batch_size, len(self.group_map[group])))
            for group, found in entries.items()
        }
        return TensorDict({**groups, **worlds}, self.batch_size, device=self.device)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the environment; see `CavVectorEnv.close`."""
        self._vec.close()
        super().close(raise_if_closed=raise_if_closed)


class _Group(NamedTuple):
    """A kind of agents."""

    ids: tuple[str, ...]
    terms: tuple[str, ...]  # terms of the reward
    observation: dict[str, TensorSpec]  # entries of the observation without `mask` and `info`
    action: TensorSpec


def _vehicles(vec: CavVectorEnv, space: spaces.Space[Any]) -> _Group:
    agents = (vec.num_envs, vec.num_agents)
    observation = {"observation": _observation_spec(space, agents)}
    if vec.roadside is not None and isinstance(vec.single_action_space, spaces.Discrete):
        observation["action_mask"] = _flags((*agents, int(vec.single_action_space.n)))
    action = _action_spec(vec.single_action_space, agents)
    return _Group(tuple(vec.possible_agents), vec.config.terms.names, observation, action)


def _of_roadside(vec: CavVectorEnv, roadside: RoadsideAgents) -> _Group:
    agents = (vec.num_envs, len(roadside.agents))
    observation = {
        "observation": _observation_spec(roadside.padded_observation_space, agents),
        "action_mask": _flags((*agents, roadside.most_choices)),
    }
    action = _action_spec(spaces.Discrete(roadside.most_choices), agents)
    return _Group(roadside.agents, roadside.terms, observation, action)


def _ends(terminated: NDArray[np.bool_], truncated: NDArray[np.bool_]) -> dict[str, Tensor]:
    """Return TorchRL's entries `terminated`, `truncated` and `done`, each with a last axis of 1."""
    ended, cut = (torch.from_numpy(flags).unsqueeze(-1) for flags in (terminated, truncated))
    return {"done": ended | cut, "terminated": ended, "truncated": cut}


def _flags(shape: tuple[int, ...]) -> Categorical:
    return Categorical(2, shape, dtype=torch.bool)


def _observation_spec(space: spaces.Space[Any], agents: tuple[int, int]) -> TensorSpec:
    """Return the spec of a Box, or of a Dict of Boxes."""
    if isinstance(space, spaces.Dict):
        return Composite(
            {name: _observation_spec(part, agents) for name, part in space.items()}, shape=agents
        )
    assert isinstance(space, spaces.Box)
    low, high = torch.from_numpy(space.low), torch.from_numpy(space.high)
    shape = (*agents, *space.shape)
    if not space.is_bounded():
        return Unbounded(shape, dtype=low.dtype)
    return Bounded(low.expand(shape), high.expand(shape), shape, dtype=low.dtype)


def _action_spec(space: spaces.Space[Any], agents: tuple[int, int]) -> TensorSpec:
    """Return the spec of continuous actions or of choices."""
    if isinstance(space, spaces.Discrete):
        return Categorical(int(space.n), agents, dtype=torch.int64)
    return Bounded(-1.0, 1.0, (*agents, 2), dtype=torch.float32)
