"""The state of a vector environment as bytes, which go into a file and hold no code."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError, EpisodeError
from cavmarl.env.actions import ActionDecoder
from cavmarl.env.declared_events import DeclaredEvents
from cavmarl.env.insertions import Insertions
from cavmarl.parallel.checkpoint.world_bytes import from_bytes, to_bytes
from cavmarl.parallel.local_worlds import every_array, kept_elsewhere
from cavmarl.parallel.step_arrays import SteppedWorlds

_DIGEST_BYTES = 32


class SavedState:
    """Base of an environment that goes on bit for bit from what it has saved."""

    worlds: SteppedWorlds
    config: EnvConfig
    _decoder: ActionDecoder
    _events: DeclaredEvents
    _insertions: Insertions
    _mask: NDArray[np.bool_]
    _ready: bool

    def save_state(self) -> bytes:
        """All that later steps depend on: of the worlds, of actions held, of what is shown.

        Raises:
            EpisodeError: before the first reset.
            ConfigError: worlds have processes or files of their own: SUMO's, a journal's.
        """
        if key := kept_elsewhere(self.config):
            raise ConfigError(
                f"{key}: worlds with processes or files of their own cannot be saved; begin their "
                "episodes anew"
            )
        if not self._ready:
            raise EpisodeError("save_state() before reset(): call vec.reset(seed=…) first")
        saved = self.worlds.save_worlds()
        sizes = np.array([len(one) for one in saved], dtype=np.int64)
        joined = np.frombuffer(b"".join(saved), dtype=np.uint8)
        content = to_bytes([*self._memory(), sizes, joined])
        return hashlib.sha256(content).digest() + content

    def load_state(self, saved: bytes) -> None:
        """Go on from what `save_state` gave; zones and workers may be others than they were.

        Raises:
            ConfigError: it is damaged, of other worlds, of another number of them, or of another
                version.
        """
        digest, content = saved[:_DIGEST_BYTES], saved[_DIGEST_BYTES:]
        if digest != hashlib.sha256(content).digest():
            raise ConfigError(
                "the state of worlds is damaged: its checksum is not that of its content; save it "
                "again"
            )
        memory = self._memory()
        like = [*memory, np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.uint8)]
        *arrays, sizes, joined = from_bytes(content, like)
        if [array.shape for array in arrays] != [array.shape for array in memory]:
            raise ConfigError(
                "the state is one of other worlds, or of another number of them: make the "
                "environment as it was when it was saved"
            )
        contents = np.split(joined, np.cumsum(sizes)[:-1])
        self.worlds.load_worlds([one.tobytes() for one in contents])
        for array, before in zip(memory, arrays, strict=True):
            array[...] = before
        self._events.memory = arrays[1]
        self._ready = True

    def _memory(self) -> list[NDArray[Any]]:
        """What is kept beside the worlds."""
        kept = (
            self._mask, self._events.memory, *self._insertions.memory, *self._decoder.memory
        )  # fmt: skip
        return [*kept, *every_array(self.worlds.arrays)]
