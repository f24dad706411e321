"""The state of a session as bytes. The bytes can be stored in a file and contain no code."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.env.step_session import StepSession
from cavmarl.parallel.state.world_bytes import from_bytes, to_bytes
from cavmarl.parallel.worlds.local_worlds import every_array, missing_in_states

_DIGEST_BYTES = 32


def save_session(session: StepSession, mask: NDArray[np.bool_]) -> bytes:
    """Return the state of a session and the mask (W, A) of its last step, as bytes.

    Raises:
        EpisodeError: before the first reset.
        ConfigError: the worlds use processes of their own, such as SUMO's.
    """
    if key := missing_in_states(session.config):
        raise ConfigError(
            f"{key}: worlds with processes of their own cannot be saved; reset them instead"
        )
    session.refuse_unready("save_state()")
    saved = session.worlds.save_worlds()
    sizes = np.array([len(one) for one in saved], dtype=np.int64)
    joined = np.frombuffer(b"".join(saved), dtype=np.uint8)
    content = to_bytes([*_memory(session, mask), sizes, joined])
    return hashlib.sha256(content).digest() + content


def load_session(session: StepSession, mask: NDArray[np.bool_], saved: bytes) -> None:
    """Restore the state that `save_session` returned, and write the mask (W, A).

    Raises:
        ConfigError: the state is damaged, or belongs to other worlds, another number of worlds or
        another version.
    """
    digest, content = saved[:_DIGEST_BYTES], saved[_DIGEST_BYTES:]
    if digest != hashlib.sha256(content).digest():
        raise ConfigError(
            "the saved state is damaged: its checksum does not match its content; save again"
        )
    memory = _memory(session, mask)
    like = [*memory, np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.uint8)]
    *arrays, sizes, joined = from_bytes(content, like)
    if [array.shape for array in arrays] != [array.shape for array in memory]:
        raise ConfigError(
            "the saved state belongs to other worlds, or to another number of worlds: make the "
            "environment with the arguments that it had when it was saved"
        )
    _, causes, *rest = arrays
    if wrong := (
        session.events.wrong(causes)
        or session.insertions.wrong(rest[:3])
        or session.decoder.wrong(rest[3:7])
        or session.external.wrong(rest[7:9])
        or session.overrides.wrong(rest[9:10])
        or session.lane_changes.wrong(rest[10:12])
        or ("the state of a world has a negative size" if (sizes < 0).any() else "")
    ):
        raise ConfigError(f"the saved state is damaged: {wrong}; save again")
    contents = np.split(joined, np.cumsum(sizes)[:-1])
    session.worlds.load_worlds([one.tobytes() for one in contents])
    for array, before in zip(memory, arrays, strict=True):
        array[...] = before
    session.events.memory = arrays[1]
    session.is_ready = True


def _memory(session: StepSession, mask: NDArray[np.bool_]) -> list[NDArray[Any]]:
    """Return the arrays to save beside the worlds."""
    waiting = session.events.memory, *session.insertions.memory, *session.decoder.memory
    waiting = *waiting, *session.external.memory, *session.overrides.memory
    waiting = *waiting, *session.lane_changes.memory
    return [mask, *waiting, *every_array(session.worlds.arrays)]
