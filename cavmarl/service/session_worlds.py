"""The worlds of a node: commands by their numbers, in one thread at a time."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from cavmarl.client.world_flows import flatten, pack
from cavmarl.core.errors import CapacityError, ConfigError
from cavmarl.env.vector import make_vec
from cavmarl.service.configurations import world_keywords
from cavmarl.service.refusals import problem

SAVED_EVERY = 50  # commands


class SessionWorld:
    """The worlds of one session.

    Args:
        document: their configuration.
        state: what another node has saved; None: they begin.
        number: commands that it includes.

    Attributes:
        number: commands up to now.
        saved: those that the state includes which the service has.
    """

    def __init__(self, document: dict[str, Any], state: bytes | None, number: int) -> None:
        self.number = self.saved = number
        self._vec = make_vec(
            document["environment"],
            num_envs=document["num_envs"],
            seed=document["seed"],
            **world_keywords(document),
        )
        self._last = b""  # the answer to the last command
        if state:
            self._vec.load_state(state)

    def describe(self) -> dict[str, Any]:
        """What a client has to know of them."""
        vec = self._vec
        actions: Any = vec.action_space
        seen: Any = vec.observation_space
        shape = getattr(seen, "shape", None)
        return {
            "number": self.number,
            "saved": self.saved,
            "agents": vec.possible_agents,
            "num_envs": vec.num_envs,
            "max_cycles": vec.max_cycles,
            "step_s": vec.step_s,
            "action": {"shape": list(actions.shape), "dtype": _little(actions.dtype)},
            "observation": {"shape": list(shape or ()), "dtype": _little(seen.dtype or "f4")},
        }

    def state(self) -> bytes | None:
        """Their state; None: it is partly elsewhere, in a SUMO or a journal."""
        try:
            return self._vec.save_state() if self.number else b""
        except ConfigError:
            return None

    def command(
        self, word: str, number: int, seed: int | None, content: bytes, is_quiet: bool
    ) -> bytes:
        """The answer to a command; to the last one again, without doing it again."""
        if number == self.number and number and self._last:
            return self._last
        if number != self.number + 1:
            raise problem("conflict", f"command {number} after {self.number}: count them up")
        answer = self._reset(seed) if word == "reset" else self._step(content)
        self.number, self._last = number, answer
        return b"" if is_quiet else answer

    def _reset(self, seed: int | None) -> bytes:
        observations, infos = self._vec.reset(seed=seed)
        return pack(flatten("observations", observations) | _flat(infos))

    def _step(self, content: bytes) -> bytes:
        form: Any = self._vec.action_space
        dtype = np.dtype(_little(form.dtype))
        wanted = dtype.itemsize * int(np.prod(form.shape))
        if len(content) != wanted:
            raise problem(
                "bad-body",
                f"actions are {len(content)} bytes: must be {wanted}, {form.shape} of {dtype.str}",
            )
        actions = np.frombuffer(content, dtype).reshape(form.shape)
        observations, rewards, ended, cut, infos = self._vec.step(actions)
        told = {"rewards": rewards, "terminations": ended, "truncations": cut}
        return pack(flatten("observations", observations) | told | _flat(infos))

    def suggestion(self) -> bytes:
        """What the built-in driver would do."""
        return pack({"actions": self._vec.suggest_actions()})

    def hashes(self) -> list[str]:
        """Digest of each world."""
        return [self._vec.state_hash(world) for world in range(self._vec.num_envs)]

    def transfers(self) -> list[dict[str, Any]]:
        """The newest changes of owner of divided worlds."""
        found = self._vec.simulation.transfers
        return [
            {"world": world, **row._asdict()} for world, log in enumerate(found) for row in log.rows
        ]

    def close(self) -> None:
        """Let go of their memory and processes."""
        self._vec.close()


class SessionWorlds:
    """The sessions of a node; one command at a time, as kernels use all of a core anyway.

    Args:
        slots: how many there may be.
    """

    def __init__(self, slots: int) -> None:
        self.lock = threading.Lock()
        self.ticks = self.steps = 0
        self.wait_s = 0.0
        self._slots = slots
        self._worlds: dict[str, SessionWorld] = {}

    def __contains__(self, session: str) -> bool:
        return session in self._worlds

    def __getitem__(self, session: str) -> SessionWorld:
        if session not in self._worlds:
            raise problem("lost", f"session '{session}' is not on this node: resolve it again")
        return self._worlds[session]

    def add(self, session: str, document: dict[str, Any], state: bytes | None, number: int) -> None:
        """Make the worlds of a session."""
        if len(self._worlds) >= self._slots:
            raise CapacityError(f"{self._slots} sessions are on this node: resolve it again later")
        with self.lock:
            if session not in self._worlds:
                self._worlds[session] = SessionWorld(document, state, number)

    def keep_only(self, sessions: set[str]) -> None:
        """Close those that are another node's now."""
        for session in [one for one in self._worlds if one not in sessions]:
            self.close(session)

    def close(self, session: str) -> None:
        """Close the worlds of a session."""
        with self.lock:
            world = self._worlds.pop(session, None)
            if world is not None:
                world.close()


def _little(dtype: Any) -> str:
    return str(np.dtype(dtype).newbyteorder("<").str)


def _flat(infos: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in infos.items():
        found |= flatten(f"infos/{name}", value)
    return found
