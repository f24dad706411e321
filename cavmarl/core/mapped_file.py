"""Memory-mapped files, where only the used parts take up memory."""

from __future__ import annotations

import mmap
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


class MappedFile(mmap.mmap):
    """The bytes of a file, read-only; all processes share the same memory."""


def mapped(path: Path) -> MappedFile:
    """Map a file. It may be replaced while it is mapped, but not overwritten.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is empty.
    """
    with path.open("rb") as file:
        return MappedFile(file.fileno(), 0, access=mmap.ACCESS_READ)


def file_of(array: NDArray[Any]) -> MappedFile | None:
    """Return the mapped file that an array is a view of, or None."""
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    found = getattr(base, "obj", base)
    return found if isinstance(found, MappedFile) else None


def let_go(file: MappedFile) -> None:
    """Release the memory of a file; later accesses read it again."""
    if hasattr(mmap, "MADV_DONTNEED"):
        file.madvise(mmap.MADV_DONTNEED)
