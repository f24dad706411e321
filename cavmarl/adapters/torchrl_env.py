"""W worlds with A agents each as an `EnvBase` of TorchRL: one batch of tensors.

Steps have no Python loop over agents. Importing this module loads TorchRL and torch;
`import cavmarl` does not import it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from cavmarl.adapters.observations import ObservationForm, refuse_decided
from cavmarl.core.errors import missing
from cavmarl.core.seeds import check_seed
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

GROUP = "car"
DECIDED = ("autoreset_mode", "copy")  # TorchRL resets worlds itself and keeps its inputs


class CavTorchRLEnv(OwnWorlds, EnvBase):  # type: ignore[misc] # TorchRL is not typed
    """W worlds with A agents each, of the batch size (W,); all agents are in the group `car`.

    Entries of a tensordict; the agents' entries have one axis more than the batch:

    - `("car", "observation")`: (W, A, D), or one entry per sensor (`observation.kind: dict`);
    - `("car", "mask")`: (W, A) whether an agent has a vehicle and acts next. Actions of other
      agents are not read. Their observations are 0, except for the last observation of an agent
      that has just ended. Use only entries where the mask is True for losses and means;
    - `("car", "action")`: (W, A, 2) within [-1, 1], or (W, A) meta-actions;
    - `("next", "car", "reward")`: (W, A, 1);
    - `("next", "car", "terminated")`, `"truncated"`, `"done"`: (W, A, 1) whether the agent's
      vehicle ended, or the horizon cut its trip. Use these for value estimators;
    - `("next", "terminated")`, `"truncated"`, `"done"`: (W, 1) for each world; TorchRL resets
      worlds that are done. `("next", "car", "observation")` then still has the last observations
      of the old episode;
    - `("next", "car", "info", term)`: (W, A, 1) each term by its name.

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
        self._form = ObservationForm(vec.config)
        self._next_seed: int | None = None
        self.max_cycles = vec.max_cycles
        self.group_map = {GROUP: vec.possible_agents}
        agents = (num_envs, vec.num_agents)
        self._term_names = vec.config.terms.names
        self.observation_spec = self._of_agents(
            observation=_observation_spec(self._form.space, agents),
            mask=_flags(agents),
            info=Composite(
                {term: Unbounded((*agents, 1)) for term in self._term_names}, shape=agents
            ),
        )
        self.action_spec = self._of_agents(action=_action_spec(vec.single_action_space, agents))
        self.reward_spec = self._of_agents(reward=Unbounded((*agents, 1)))
        ends = {name: _flags((num_envs, 1)) for name in ("done", "terminated", "truncated")}
        self.done_spec = Composite(
            **ends,
            **{GROUP: Composite({name: _flags((*agents, 1)) for name in ends}, shape=agents)},
            shape=self.batch_size,
        )
        self._no_terms = np.zeros((*agents, len(vec.config.terms.names)), dtype=np.float32)

    @property
    def vec(self) -> CavVectorEnv:
        """The worlds behind this view."""
        return self._vec

    def _of_agents(self, **specs: TensorSpec) -> Composite:
        """Return a spec of the group's entries."""
        agents = (*self.batch_size, len(self.group_map[GROUP]))
        return Composite({GROUP: Composite(specs, shape=agents)}, shape=self.batch_size)

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
        none = np.zeros_like(infos["mask"])
        everywhere = np.zeros(len(none), dtype=np.bool_)
        return self._tensors(
            self._agents(observations, infos["mask"], self._no_terms) | _ends(none, none),
            _ends(everywhere, everywhere),
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        actions = tensordict.get((GROUP, "action")).cpu().numpy()
        observations, rewards, ended, cut, infos = self._vec.step(actions)
        over = infos["episode_over"]
        at_horizon = cut.any(axis=1)
        agents = self._agents(observations, infos["mask"], infos["terms"]) | _ends(ended, cut)
        agents["reward"] = torch.from_numpy(rewards).unsqueeze(-1)
        return self._tensors(agents, _ends(over & ~at_horizon, over & at_horizon))

    def _agents(
        self, flat: NDArray[np.float32], mask: NDArray[np.bool_], terms: NDArray[np.float32]
    ) -> dict[str, Any]:
        """Return the entries of the agents; arrays are not copied."""
        shown = self._form(flat)
        columns = torch.from_numpy(terms)
        return {
            "observation": torch.from_numpy(shown)
            if isinstance(shown, np.ndarray)
            else {name: torch.from_numpy(part) for name, part in shown.items()},
            "mask": torch.from_numpy(mask),
            "info": {term: columns[..., k : k + 1] for k, term in enumerate(self._term_names)},
        }

    def _tensors(self, agents: Mapping[str, Any], worlds: Mapping[str, Tensor]) -> TensorDict:
        agent_arrays = TensorDict(agents, (*self.batch_size, self._vec.num_agents))
        return TensorDict({GROUP: agent_arrays, **worlds}, self.batch_size, device=self.device)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the environment; see `CavVectorEnv.close`."""
        self._vec.close()
        super().close(raise_if_closed=raise_if_closed)


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
