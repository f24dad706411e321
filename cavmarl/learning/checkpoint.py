"""Checkpoints: one file with all that a run goes on from, whole or not there."""

from __future__ import annotations

import hashlib
import io
import random
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cavmarl.core.atomic_file import write_whole
from cavmarl.core.errors import TrainingError
from cavmarl.evaluate.provenance.training_record import CHECKPOINT_FILE

_HEAD = b"cavmarl checkpoint 1\n"  # then a SHA-256 of the rest
_DIGEST_BYTES = 32

Parts = dict[str, Any]
"""Tensors, numbers, words, and lists and dicts of them: no code."""


@dataclass(frozen=True)
class RunState:
    """Where a run stands after an update."""

    program: str  # that trains
    settings: Parts  # by name
    environment: str  # digest of it
    agent_steps: int = 0  # decisions that it learned from
    updates: int = 0  # of the network
    seconds: float = 0.0  # spent on them
    logs: dict[str, int] = field(default_factory=dict)  # bytes of each file of them
    random: Parts = field(default_factory=dict)  # see `random_states`
    parts: Parts = field(default_factory=dict)  # of the program


def write_checkpoint(folder: Path, state: RunState) -> None:
    """Raises OSError: it cannot be written; the one before is as it was."""
    file = io.BytesIO()
    torch.save(vars(state), file)
    write_whole(folder / CHECKPOINT_FILE, sealed(file.getvalue()))


def sealed(content: bytes) -> bytes:
    """What a checkpoint's file holds: its version and checksum, and the content."""
    return _HEAD + hashlib.sha256(content).digest() + content


def read_checkpoint(folder: Path) -> RunState:
    """The checkpoint of a run's folder.

    Raises:
        TrainingError: there is none, or it is not what was written.
    """
    path = folder / CHECKPOINT_FILE
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise TrainingError(
            f"--resume {folder}: no checkpoint there ({error.strerror}); give the folder of a run, "
            "or begin one without --resume"
        ) from error
    content = raw[len(_HEAD) + _DIGEST_BYTES :]
    if raw != sealed(content):
        raise _broken(path, "its checksum is not that of its content")
    try:
        return RunState(**torch.load(io.BytesIO(content), "cpu", weights_only=True))
    except Exception as error:  # torch's reader raises what it meets
        raise _broken(path, str(error).partition("\n")[0]) from error


def _broken(path: Path, why: str) -> TrainingError:
    return TrainingError(
        f"{path}: is damaged, or of another version ({why}): put a copy of it in its place, or "
        "train anew under another --name"
    )


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """The time in which a file of a run's folder is written: full disks are typed errors."""
    try:
        yield
    except OSError as error:
        cure = "make room for it, then begin again"
        if (path.parent / CHECKPOINT_FILE).exists():
            cure = f"make room for it, then go on from the last checkpoint: --resume {path.parent}"
        raise TrainingError(
            f"{path}: cannot be written ({error.strerror or error}): {cure}"
        ) from error


def random_states() -> Parts:
    """Where the generators of torch, NumPy and Python stand."""
    kind, keys, *rest = np.random.get_state()
    return {
        "torch": torch.get_rng_state(),
        "numpy": [kind, torch.from_numpy(np.array(keys, dtype=np.int64)), *rest],
        "python": random.getstate(),
    }


def set_random_states(states: Parts) -> None:
    torch.set_rng_state(states["torch"])
    kind, keys, *rest = states["numpy"]
    np.random.set_state((kind, keys.numpy().astype(np.uint32), *rest))
    random.setstate(states["python"])


def tensor_of(content: bytes) -> Tensor:
    """Bytes, as a checkpoint takes them."""
    return torch.frombuffer(bytearray(content), dtype=torch.uint8)


def bytes_of(tensor: Tensor) -> bytes:
    return tensor.numpy().tobytes()
