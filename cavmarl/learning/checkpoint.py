"""Checkpoints: one file with the whole state of a run, replaced atomically."""

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

_HEAD = b"cavmarl checkpoint 1\n"  # followed by a SHA-256 of the content
_DIGEST_BYTES = 32

Parts = dict[str, Any]
"""Tensors, numbers, strings, and lists and dicts of them; no code."""


@dataclass(frozen=True)
class RunState:
    """The state of a run after an update."""

    program: str  # the training program
    settings: Parts  # settings by name
    environment: str  # digest of the environment
    agent_steps: int = 0  # number of decisions used for learning
    updates: int = 0  # number of updates of the network
    seconds: float = 0.0  # training time
    logs: dict[str, int] = field(default_factory=dict)  # size of each log file in bytes
    random: Parts = field(default_factory=dict)  # see `random_states`
    parts: Parts = field(default_factory=dict)  # state of the program
    shares: list[Parts] = field(default_factory=list)  # `random` and `parts` of ranks 1, 2, …


def write_checkpoint(folder: Path, state: RunState) -> None:
    """Write the checkpoint. Raises OSError: it cannot be written; the previous one is intact."""
    file = io.BytesIO()
    torch.save(vars(state), file)
    write_whole(folder / CHECKPOINT_FILE, sealed(file.getvalue()))


def sealed(content: bytes) -> bytes:
    """Return the content of a checkpoint file: version, checksum and content."""
    return _HEAD + hashlib.sha256(content).digest() + content


def read_checkpoint(folder: Path) -> RunState:
    """Read the checkpoint of a run's folder.

    Raises:
        TrainingError: there is none, or it is damaged.
    """
    path = folder / CHECKPOINT_FILE
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise TrainingError(
            f"--resume {folder}: has no checkpoint ({error.strerror}); give the folder of a run, "
            "or start a run without --resume"
        ) from error
    content = raw[len(_HEAD) + _DIGEST_BYTES :]
    if raw != sealed(content):
        raise _broken(path, "wrong checksum")
    try:
        return RunState(**torch.load(io.BytesIO(content), "cpu", weights_only=True))
    except Exception as error:  # torch's reader raises errors of many types
        raise _broken(path, str(error).partition("\n")[0]) from error


def _broken(path: Path, why: str) -> TrainingError:
    return TrainingError(
        f"{path}: is damaged, or of another version ({why}); restore a copy of it, or train "
        "again under another --name"
    )


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raise a TrainingError with a cure if the code inside cannot write a file of a run."""
    try:
        yield
    except OSError as error:
        cure = "free some space, then start again"
        if (path.parent / CHECKPOINT_FILE).exists():
            cure = f"free some space, then resume the last checkpoint: --resume {path.parent}"
        raise TrainingError(
            f"{path}: cannot be written ({error.strerror or error}); {cure}"
        ) from error


def random_states() -> Parts:
    """Return the random states of torch, NumPy and Python."""
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
    """Return bytes as a tensor that a checkpoint can store."""
    return torch.frombuffer(bytearray(content), dtype=torch.uint8)


def bytes_of(tensor: Tensor) -> bytes:
    return tensor.numpy().tobytes()
