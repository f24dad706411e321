"""Checks the actions of agents before any state changes, and decodes them for the shards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.action import ActionConfig
from cavmarl.core.compiled import specialized
from cavmarl.core.errors import ActionError
from cavmarl.core.records.codes import ACTION_IDLE
from cavmarl.engine.kernels.decoding import decode_choices, decode_pairs
from cavmarl.shards.shard import Commands

# Values of `parallel_env(lenient=True)`.
LENIENT = {
    "action.out_of_range": "clip",
    "action.missing_action": "hold",
    "action.late_actions": "ignore",
}


class ActionDecoder:
    """Checks and decodes the actions of W worlds with A agents each.

    Attributes:
        clipped: (W,) values beyond ±1 that were clipped in this episode (`out_of_range = clip`).
        held: (W,) missing actions that were replaced by the last action (`missing_action = hold`).
        ignored: (W,) actions for agents that had left (`late_actions = ignore`).
    """

    def __init__(
        self,
        config: ActionConfig,  # what the agents can do
        num_worlds: int,  # W
        agents: Sequence[str],  # ids of the A agents
        # output, overwritten in each step; None: new arrays
        commands: Commands | None = None,
    ) -> None:
        self._config = config
        self._agents = tuple(agents)
        self._index = {agent: k for k, agent in enumerate(agents)}
        self._continuous = config.kind == "continuous"
        shape = (num_worlds, len(agents))
        self._last: NDArray[Any] = (
            np.zeros((*shape, 2), dtype=np.float64)
            if self._continuous
            else np.full(shape, config.idle_choice, dtype=np.int64)
        )
        self._idle = self._last.copy()
        # The scale has the full shape, because NumPy takes four times as long to broadcast a pair.
        self._scale = np.empty((*shape, 2))
        self._scale[:] = config.acceleration_mps2, config.steering_rad
        if commands is None:
            commands = Commands(np.empty((*shape, 2)), np.empty(shape, dtype=np.int64))
        # (choices, 2): acceleration (m/s²) and steering angle (rad) of each choice of a grid
        self._pairs = np.array(config.pairs) * (config.acceleration_mps2, config.steering_rad)
        commands.controls[:] = 0.0
        commands.meta_actions[:] = ACTION_IDLE
        self._decoded = commands
        self._decode_pairs = {np.dtype(kind): specialized(decode_pairs) for kind in ("f4", "f8")}
        self._decode_choices = specialized(decode_choices)
        self.clipped = np.zeros(num_worlds, dtype=np.int64)
        self.held = np.zeros(num_worlds, dtype=np.int64)
        self.ignored = np.zeros(num_worlds, dtype=np.int64)

    @property
    def last(self) -> NDArray[Any]:
        """The actions (W, A, …) of the last step, after clipping; idle actions after a reset."""
        return self._last

    @property
    def memory(self) -> tuple[NDArray[Any], ...]:
        """The last actions and the counts of `tolerated`, as arrays that can be saved."""
        return self._last, self.clipped, self.held, self.ignored

    @memory.setter
    def memory(self, memory: tuple[NDArray[Any], ...]) -> None:
        self._last, self.clipped, self.held, self.ignored = memory

    def wrong(self, memory: Sequence[NDArray[Any]]) -> str:
        """Return what is wrong with a loaded `memory`; empty if it is valid."""
        last, *counts = memory
        if any((count < 0).any() for count in counts):
            return "a count of tolerated actions is negative"
        low, high = (-1.0, 1.0) if self._continuous else (0, self._config.choices - 1)
        return "" if ((last >= low) & (last <= high)).all() else "a last action is out of range"

    def tolerated(self, world: int = 0) -> dict[str, int]:
        """Return how many actions of a world's episode were tolerated, by key of traffic_stats."""
        return {
            "actions_clipped": int(self.clipped[world]),
            "actions_held": int(self.held[world]),
            "actions_ignored": int(self.ignored[world]),
        }

    def forget(self, chosen: NDArray[np.bool_]) -> None:
        """Begin an episode in the chosen worlds (W,): clear the last actions and all counts."""
        self._last[chosen] = self._idle[chosen]
        for count in (self.clipped, self.held, self.ignored):
            count[chosen] = 0

    def check(self, agent: str, action: Any) -> None:
        """Raise an error for an action that cannot be decoded, without decoding it.

        Raises:
            ActionError: wrong shape, dtype or value.
        """
        batch = self._idle[:1].copy()
        batch[0, self._index[agent]] = self._stack([action], [agent])[0]
        self._check_values(batch)

    def idle(self) -> Commands:
        """Return the commands of a step in which no agent acts."""
        return self._commands(self._idle)

    def from_dict(
        self, actions: Mapping[str, Any], live: Sequence[str], needed: Sequence[str]
    ) -> Commands:
        """Decode the actions of one world. Only actions of `needed` agents are read."""
        if not isinstance(actions, Mapping):
            raise ActionError(
                f"actions are a {type(actions).__name__}: pass a dict from agent id to action"
            )
        ignored = self._check_ids(actions, live)
        missing = [agent for agent in needed if agent not in actions]
        if missing and self._config.missing_action == "error":
            raise ActionError(
                f"no action for {', '.join(missing)}: pass one for each id in env.agents, or set "
                "action.missing_action = hold"
            )
        given = [agent for agent in needed if agent in actions] if missing else needed
        batch = self._idle.copy()
        if missing:
            held = self._rows_of(missing)
            batch[0, held] = self._last[0, held]
        if given:
            stacked = self._stack(list(map(actions.__getitem__, given)), given)
            batch[0, self._rows_of(given)] = stacked
        checked, clipped = self._check_values(batch)
        self.ignored += ignored
        self.held += len(missing)
        self.clipped += clipped
        self._last = checked
        return self._commands(checked)

    def from_array(self, actions: Any, mask: NDArray[np.bool_]) -> Commands:
        """Decode the actions of all worlds. Entries where `mask` (W, A) is False are not read."""
        if self._decode_fast(actions, mask):
            return self._decoded
        array = self._as_numbers(actions, "actions")
        if array.shape != self._last.shape:
            raise ActionError(
                f"actions have shape {array.shape}: must be {self._last.shape}, "
                "(num_envs, num_agents" + (", 2)" if self._continuous else ")")
            )
        is_read = mask.repeat(2, axis=1).reshape(array.shape) if self._continuous else mask
        batch = np.where(is_read, array, self._idle)
        checked, clipped = self._check_values(batch)
        self.clipped += clipped
        self._last = checked
        return self._commands(checked)

    def _decode_fast(self, actions: Any, mask: NDArray[np.bool_]) -> bool:
        """Decode arrays of a common dtype whose values are in range; otherwise return False."""
        if type(actions) is not np.ndarray or actions.shape != self._last.shape:
            return False
        if not (actions.flags.carray and mask.flags.carray):
            return False
        if not self._continuous:
            if actions.dtype != np.int64:
                return False
            config = self._config
            if not self._decode_choices(
                actions, mask, config.idle_choice, config.choices, self._last
            ):
                return False
            self._commands(self._last)
            return True
        decode = self._decode_pairs.get(actions.dtype)
        if decode is None:
            return False
        config = self._config
        return decode(
            actions, mask, config.acceleration_mps2, config.steering_rad,
            self._last, self._decoded.controls,
        )  # fmt: skip

    def encode(self, raw: NDArray[np.float64]) -> NDArray[Any]:
        """Return the actions (W, A, …) nearest to raw controls (W, A, 2); inverse of decoding."""
        if self._continuous:
            shares: NDArray[Any] = np.clip(raw / self._scale, -1.0, 1.0).astype(np.float32)
            return shares
        config = self._config
        if config.kind == "discrete":
            return raw[..., 0].astype(np.int64)
        pair = raw / self._scale
        rows = _nearest(config.grid_throttle, pair[..., 0])
        return rows * len(config.grid_steering) + _nearest(config.grid_steering, pair[..., 1])

    def _rows_of(self, agents: Sequence[str]) -> NDArray[np.intp] | slice:
        if tuple(agents) == self._agents:
            return slice(None)
        return np.array([self._index[agent] for agent in agents], dtype=np.intp)

    def _check_ids(self, actions: Mapping[str, Any], live: Sequence[str]) -> int:
        """Return how many actions are for absent agents; raise an error for unknown ids."""
        alive = set(live)
        if actions.keys() <= alive:
            return 0
        unknown = [agent for agent in actions if agent not in self._index]
        if unknown:
            raise ActionError(
                f"no agent {unknown[0]!r}: the ids are {self._agents[0]} … {self._agents[-1]}"
            )
        late = [agent for agent in actions if agent not in alive]
        if late and self._config.late_actions == "error":
            raise ActionError(
                f"{', '.join(late)}: not in the episode; pass actions for the ids in env.agents "
                "only, or set action.late_actions = ignore"
            )
        return len(late)

    def _stack(self, values: list[Any], agents: Sequence[str]) -> NDArray[Any]:
        """Return the actions as one array; raise an error for a wrong shape or dtype."""
        alike = self._stack_uniform(values)
        if alike is not None:
            return alike
        shape = self._last.shape[2:]
        arrays = []
        for agent, value in zip(agents, values, strict=True):
            array = self._as_numbers(value, agent)
            if array.shape != shape:
                raise ActionError(f"{agent}: the action has shape {array.shape}, must be {shape}")
            arrays.append(array)
        return np.stack(arrays)

    def _stack_uniform(self, values: list[Any]) -> NDArray[Any] | None:
        """Return the actions as one array if they share a type that needs no check of each action.

        Otherwise return None. This fast path takes a fifth of the time; most policies use it.
        """
        kinds = set(map(type, values))
        if self._continuous:
            if kinds != {np.ndarray} or {value.shape for value in values} != {(2,)}:
                return None
            if {value.dtype.kind for value in values} == {"f"}:
                pairs: NDArray[Any] = np.concatenate(values).reshape(-1, 2)
                return pairs
        elif kinds == {int} or kinds == {np.int64}:
            array = np.array(values)
            return array if array.dtype == np.int64 else None
        return None

    def _as_numbers(self, value: Any, name: str) -> NDArray[Any]:
        """Return an array of a dtype allowed for actions; raise an error for any other dtype."""
        kind = (
            "floats (float32 or float64) in [-1, 1]"
            if self._continuous
            else "whole numbers (int64)"
        )
        try:
            array = np.asarray(value)
        except ValueError as error:
            raise ActionError(f"{name}: not an array of {kind}: {error}") from error
        if array.dtype.kind not in ("f" if self._continuous else "iu"):
            raise ActionError(
                f"{name}: dtype is {array.dtype}; with action.kind = {self._config.kind}, pass "
                f"{kind}"
            )
        if array.dtype == np.uint64:
            # A cast of the largest values to int64 would wrap around.
            array = np.minimum(array, np.uint64(np.iinfo(np.int64).max)).astype(np.int64)
        return array

    def _check_values(self, batch: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int64] | int]:
        """Return the values in range, and how many values were clipped in each world."""
        if not self._continuous:
            wrong = (batch < 0) | (batch >= self._config.choices)
            if wrong.any():
                self._refuse(batch, wrong, f"must be from 0 to {self._config.choices - 1}")
            return batch, 0
        size = np.abs(batch)
        if size.max(initial=0.0) <= 1.0:  # also False for NaN
            return batch, 0
        beyond = ~(size <= 1.0)
        if not np.isfinite(batch).all():
            self._refuse(batch, ~np.isfinite(batch), "must be finite")
        if self._config.out_of_range == "error":
            self._refuse(
                batch, beyond, "must be within [-1, 1]; to clip it, set action.out_of_range = clip"
            )
        return np.clip(batch, -1.0, 1.0), beyond.sum(axis=(1, 2))

    def _refuse(self, batch: NDArray[Any], wrong: NDArray[np.bool_], why: str) -> None:
        place = tuple(int(k) for k in np.argwhere(wrong)[0])
        where = f"{self._agents[place[1]]}"
        if batch.shape[0] > 1:
            where = f"world {place[0]}, {where}"
        if len(place) > 2:
            where += f", {('throttle', 'steering')[place[2]]}"
        raise ActionError(f"{where}: the action is {batch[place]}, {why}")

    def _commands(self, batch: NDArray[Any]) -> Commands:
        decoded = self._decoded
        if self._continuous:
            np.multiply(batch, self._scale, out=decoded.controls)
            np.add(decoded.controls, 0.0, out=decoded.controls)  # turns -0.0 into 0.0
        elif self._config.kind == "grid":
            decoded.controls[:] = self._pairs[batch]
        else:
            decoded.meta_actions[:] = batch
        return decoded


def _nearest(values: tuple[float, ...], wanted: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the index of the value nearest to each wanted value; the first one on a tie."""
    away = np.abs(wanted[..., None] - np.array(values))
    found: NDArray[np.int64] = away.argmin(axis=-1)
    return found
