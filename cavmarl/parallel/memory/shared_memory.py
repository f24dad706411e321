"""Memory that processes share. The memory has no name, so nothing is left behind.

A process knows a segment only by its descriptor, which it receives when it starts. The system frees
a segment when the last process that has it open or mapped ends, whatever the cause.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cavmarl.core.errors import WorkerError
from cavmarl.core.processes import occupy_standard_descriptors

Layout = Mapping[str, tuple[str, tuple[int, ...]]]
"""Arrays of a segment: name → dtype as text, and shape."""

_LINE = 64  # bytes of a cache line: no two arrays share one


class Segment:
    """Shared memory whose bytes are all allocated."""

    def __init__(
        self,
        fd: int,  # file descriptor; the segment takes ownership and closes it
        size: int,  # bytes
    ) -> None:
        self.fd = fd  # to be passed to other processes
        self.size = size

    @classmethod
    def make(cls, size: int) -> Segment:
        """Make a segment of zeros.

        Raises:
            WorkerError: there is not enough memory.
        """
        try:
            free = _free_bytes()
            if free is not None and size > free:
                raise WorkerError(_too_much(size, f"{free / 1e9:.1f} GB are free"))
            segment = cls(_anonymous(), 0)
        except OSError as error:
            raise WorkerError(f"no shared memory: {error}") from error
        try:
            segment.grow(size)
        except OSError as error:
            segment.close()
            raise WorkerError(_too_much(size, str(error))) from error
        return segment

    def grow(self, size: int) -> None:
        """Grow to at least this number of bytes.

        Raises:
            OSError: there is not enough memory.
        """
        if size > self.size:
            os.posix_fallocate(self.fd, 0, size)
            self.size = size

    def map(self) -> mmap.mmap:
        """Map the segment at its current size, which another process may have changed."""
        self.size = os.fstat(self.fd).st_size
        try:
            return mmap.mmap(self.fd, self.size)
        except OSError as error:
            raise WorkerError(f"shared memory cannot be mapped: {error}") from error

    def close(self) -> None:
        """Close the descriptor; existing mappings stay valid while they are referenced."""
        os.close(self.fd)


def size_of(layout: Layout) -> int:
    return max(_LINE, sum(_room(dtype, shape) for dtype, shape in layout.values()))


def arrays_in(memory: mmap.mmap, layout: Layout) -> dict[str, NDArray[Any]]:
    """Return the arrays in the bytes of a segment, each at the start of a cache line."""
    found: dict[str, NDArray[Any]] = {}
    at = 0
    for name, (dtype, shape) in layout.items():
        flat = np.frombuffer(memory, dtype=dtype, count=prod(shape), offset=at)
        found[name] = flat.reshape(shape)
        at += _room(dtype, shape)
    return found


def shared_zeros(shape: int | tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Return zeros that this process shares with the processes that it forks.

    The system allocates a page when it is first written.
    """
    kind = np.dtype(dtype)
    sides = (shape,) if isinstance(shape, int) else shape
    memory = mmap.mmap(-1, max(1, prod(sides) * kind.itemsize))
    return np.frombuffer(memory, dtype=kind, count=prod(sides)).reshape(sides)


def _room(dtype: str, shape: tuple[int, ...]) -> int:
    return -(-np.dtype(dtype).itemsize * prod(shape) // _LINE) * _LINE


def _anonymous() -> int:
    occupy_standard_descriptors()
    if hasattr(os, "memfd_create"):
        return os.memfd_create("cavmarl", os.MFD_CLOEXEC)
    fd, path = tempfile.mkstemp(prefix="cavmarl-")
    os.unlink(path)
    return fd


def _free_bytes() -> int | None:
    info = Path("/proc/meminfo")
    if not info.is_file():
        return None
    for line in info.read_text(encoding="ascii").splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return None


def _too_much(size: int, why: str) -> str:
    return (
        f"no {size / 1e9:.2f} GB of shared memory ({why}): use a smaller num_envs, fewer agents or "
        "smaller observations"
    )
