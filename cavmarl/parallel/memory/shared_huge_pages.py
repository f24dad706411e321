"""Memory that a process shares with its forks, in huge pages if the system has them.

The vehicles of a city take thousands of small pages. In a virtual machine, translating their
addresses takes a few percent of a tick. By default, most systems give no huge pages to shared
memory (`shmem_enabled`), but Linux from 6.1 on merges pages on request. If Linux cannot merge them,
the program is only slower.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import weakref
from math import prod
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cavmarl.parallel.memory.shared_memory import shared_zeros

HUGE_BYTES = 1 << 21  # size of a huge page, on most processors
MOST_BYTES = 1 << 28  # larger arrays have small pages

_NO_ACCESS = 0  # PROT_NONE: reserves addresses only
_AT_THIS_PLACE = 0x10  # MAP_FIXED
COLLAPSE = 25  # MADV_COLLAPSE, which Python's mmap does not know
_FAILED = ctypes.c_void_p(-1).value

_libc = ctypes.CDLL(None, use_errno=True)
_libc.mmap.restype = ctypes.c_void_p
_libc.mmap.argtypes = (
    ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long,
)  # fmt: skip
_libc.munmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t)
_libc.madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)


def huge_shared_zeros(shape: int | tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Return zeros like `shared_zeros`; large arrays use huge pages if the system has any.

    An array of more than `MOST_BYTES` has small pages, each allocated when it is first written.

    Raises:
        MemoryError: this process does not have enough address space or memory.
    """
    kind = np.dtype(dtype)
    sides = (shape,) if isinstance(shape, int) else shape
    size = prod(sides) * kind.itemsize
    if not HUGE_BYTES <= size <= MOST_BYTES:
        return shared_zeros(shape, dtype)
    memory = _map_aligned(size)
    whole = size // HUGE_BYTES * HUGE_BYTES  # the rest stays in small pages
    for place in range(0, whole, HUGE_BYTES):
        memory[place] = b"\0"  # only allocated pages can be merged
    _libc.madvise(ctypes.addressof(memory), whole, COLLAPSE)  # if it fails, pages stay small
    return np.frombuffer(memoryview(memory), dtype=kind, count=prod(sides)).reshape(sides)


def collapse_heap() -> None:
    """Merge the heap of this process into huge pages if the system has free huge pages.

    Forked processes then share fewer pages. The system reports the death of a process only after it
    has released all pages of the process. With fewer pages, deaths are noticed sooner.
    """
    with open("/proc/self/maps", encoding="utf-8") as maps:
        heaps = [line.split()[0] for line in maps if line.rstrip().endswith("[heap]")]
    for heap in heaps:
        first, last = (int(place, 16) for place in heap.split("-"))
        first, last = -(-first // HUGE_BYTES) * HUGE_BYTES, last // HUGE_BYTES * HUGE_BYTES
        if first < last:
            _libc.madvise(first, last - first, COLLAPSE)  # if it fails, pages stay small


def _map_aligned(size: int) -> ctypes.Array[ctypes.c_char]:
    """Return shared memory at a boundary of huge pages; it is freed with the object."""
    room = size + HUGE_BYTES
    private, shared = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, mmap.MAP_SHARED | mmap.MAP_ANONYMOUS
    first = _libc.mmap(None, room, _NO_ACCESS, private, -1, 0)
    if first == _FAILED:
        raise MemoryError(f"no room for {size} bytes: {os.strerror(ctypes.get_errno())}")
    start = -(-first // HUGE_BYTES) * HUGE_BYTES
    access = mmap.PROT_READ | mmap.PROT_WRITE
    if _libc.mmap(start, size, access, shared | _AT_THIS_PLACE, -1, 0) == _FAILED:
        why = os.strerror(ctypes.get_errno())
        _libc.munmap(first, room)
        raise MemoryError(f"no shared memory of {size} bytes: {why}")
    memory = (ctypes.c_char * size).from_address(start)
    # Not at exit: other objects may still use the memory, and the system frees it anyway.
    weakref.finalize(memory, _libc.munmap, first, room).atexit = False
    return memory
