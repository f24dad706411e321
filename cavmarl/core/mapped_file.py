"""Files whose bytes are read where the system keeps them: memory has only what is used of them."""

from __future__ import annotations

import mmap
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


class MappedFile(mmap.mmap):
    """The bytes of a file, which cannot be written; the same memory for all processes."""


def mapped(path: Path) -> MappedFile:
    """Map a file. It may be replaced meanwhile, but not written.

    Raises:
        OSError: it cannot be read.
        ValueError: it is empty.
    """
    with path.open("rb") as file:
        return MappedFile(file.fileno(), 0, access=mmap.ACCESS_READ)


def file_of(array: NDArray[Any]) -> MappedFile | None:
    """The mapped file that an array is a view of; None: it is of none."""
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    found = getattr(base, "obj", base)
    return found if isinstance(found, MappedFile) else None


def let_go(file: MappedFile) -> None:
    """Give the memory of a file back; what is used from now on is read again."""
    if hasattr(mmap, "MADV_DONTNEED"):
        file.madvise(mmap.MADV_DONTNEED)
