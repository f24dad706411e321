"""The state of a session as bytes, which go into a file and hold no code."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.env.step_session import StepSession
from cavmarl.parallel.state.world_bytes import from_bytes, to_bytes
from cavmarl.parallel.worlds.local_worlds import every_array, kept_elsewhere

_DIGEST_BYTES = 32


def save_session(session: StepSession, mask: NDArray[np.bool_]) -> bytes:
    """Return all that later steps of a session depend on, and the mask (W, A) of its last step.

    Raises:
        EpisodeError: before the first reset.
        ConfigError: worlds have processes of their own: SUMO's.
    """
    if key := kept_elsewhere(session.config):
        raise ConfigError(
            f"{key}: worlds with processes of their own cannot be saved; begin their episodes anew"
        )
    session.refuse_unready("save_state()")
    saved = session.worlds.save_worlds()
    sizes = np.array([len(one) for one in saved], dtype=np.int64)
    joined = np.frombuffer(b"".join(saved), dtype=np.uint8)
    content = to_bytes([*_memory(session, mask), sizes, joined])
    return hashlib.sha256(content).digest() + content


def load_session(session: StepSession, mask: NDArray[np.bool_], saved: bytes) -> None:
    """Let a session go on from what `save_session` returned, and write the mask (W, A).

    Raises:
        ConfigError: it is damaged, of other worlds, of another number of them, or of another
            version.
    """
    digest, content = saved[:_DIGEST_BYTES], saved[_DIGEST_BYTES:]
    if digest != hashlib.sha256(content).digest():
        raise ConfigError(
            "the state of worlds is damaged: its checksum is not that of its content; save it again"
        )
    memory = _memory(session, mask)
    like = [*memory, np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.uint8)]
    *arrays, sizes, joined = from_bytes(content, like)
    if [array.shape for array in arrays] != [array.shape for array in memory]:
        raise ConfigError(
            "the state is one of other worlds, or of another number of them: make the environment "
            "as it was when it was saved"
        )
    contents = np.split(joined, np.cumsum(sizes)[:-1])
    session.worlds.load_worlds([one.tobytes() for one in contents])
    for array, before in zip(memory, arrays, strict=True):
        array[...] = before
    session.events.memory = arrays[1]
    session.is_ready = True


def _memory(session: StepSession, mask: NDArray[np.bool_]) -> list[NDArray[Any]]:
    """Return what is kept beside the worlds."""
    waiting = session.events.memory, *session.insertions.memory, *session.decoder.memory
    return [mask, *waiting, *every_array(session.worlds.arrays)]
