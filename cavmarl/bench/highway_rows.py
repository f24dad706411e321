"""highway-env's worlds in processes, with every agent as a row of a stable-baselines3 `VecEnv`."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnvWrapper

from cavmarl.bench.highway_worlds import highway_env
from cavmarl.core.errors import require


class HighwayRows(VecEnvWrapper):
    """A `VecEnv` with one row per controlled vehicle; the rows of a world end together.

    The rows of a world have equal rewards. Each world runs in its own process, has no other
    vehicles, and restarts after `horizon_s`.
    `observation` has highway-env's settings.
    """

    def __init__(
        self, worlds: int, agents: int, observation: dict[str, Any], horizon_s: float
    ) -> None:
        make = partial(_World, agents, observation, horizon_s)
        processes = SubprocVecEnv([make] * worlds, start_method="spawn")
        _, size = processes.observation_space.shape or (0, 0)
        super().__init__(
            processes,
            spaces.Box(-np.inf, np.inf, (size,), np.float32),
            spaces.Discrete(int(processes.action_space.nvec[0])),  # type: ignore[attr-defined]
        )
        self._agents = agents
        self.num_envs = worlds * agents
        self.simulated_s = 0.0  # time of all steps, including communication between processes

    def reset(self) -> NDArray[np.float32]:
        """Restart all worlds; return observations (W · A, D)."""
        return self._rows(self.venv.reset())

    def step_async(self, actions: NDArray[Any]) -> None:
        """Send actions (W · A,) to the processes."""
        self._began = time.perf_counter()
        self.venv.step_async(actions.reshape(-1, self._agents))

    def step_wait(self) -> Any:
        observations, rewards, done, infos = self.venv.step_wait()
        self.simulated_s += time.perf_counter() - self._began
        each = self._agents
        row_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for world in np.flatnonzero(done).tolist():
            info = infos[world]
            cut = {"TimeLimit.truncated": info["TimeLimit.truncated"]}
            for k, last in enumerate(info["terminal_observation"]):
                row_infos[world * each + k] = {"terminal_observation": last, **cut}
        return self._rows(observations), rewards.repeat(each), done.repeat(each), row_infos

    def _rows(self, observations: Any) -> NDArray[np.float32]:
        rows: NDArray[np.float32] = observations.reshape(self.num_envs, -1)
        return rows


class _World(gymnasium.Env[Any, Any]):
    """One world of highway-env, with one array for all agents."""

    def __init__(self, agents: int, observation: dict[str, Any], horizon_s: float) -> None:
        require("highway_env", "bench")  # registers the environment in this process
        self._env = highway_env(agents, observation)
        self._env.configure({"duration": horizon_s})
        size = self._stack(self._env.reset(seed=0)[0]).shape
        self.observation_space = spaces.Box(-np.inf, np.inf, size, np.float32)
        self.action_space = spaces.MultiDiscrete([space.n for space in self._env.action_space])

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return self._stack(self._env.reset(seed=seed)[0]), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        seen, reward, terminated, truncated, _ = self._env.step(tuple(action))
        return self._stack(seen), float(reward), bool(terminated), bool(truncated), {}

    @staticmethod
    def _stack(seen: Any) -> NDArray[np.float32]:
        return np.stack([one.ravel() for one in seen]).astype(np.float32)
