"""Arrays in huge pages, which save address translations when a tick reads scattered memory.

In a virtual machine, a page that is not in the processor's translation buffer costs two walks
through page tables. Linux provides pages of 2 MiB on request, unless these pages are switched off
(`/sys/kernel/mm/transparent_hugepage/enabled`). On other systems, arrays are NumPy's own.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import sys
import threading
from math import prod
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

PAGE = 1 << 21  # size of a huge page in bytes
LEAST = 1 << 16  # bytes; smaller arrays gain nothing
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None
_TUNABLES = "GLIBC_TUNABLES"
_LINE = 64  # bytes of a cache line, which no two arrays share


class _Pages:
    """Whole pages from which arrays are cut one after another; freed with the last array."""

    def __init__(self) -> None:
        self._bytes = np.zeros(0, dtype=np.uint8)
        self._lock = threading.Lock()

    def take(self, size: int) -> NDArray[np.uint8]:
        """Return `size` bytes, all 0."""
        with self._lock:
            if size > self._bytes.size:
                self._bytes = _map(-(-size // PAGE) * PAGE)
            taken = self._bytes[:size]
            self._bytes = self._bytes[-(-size // _LINE) * _LINE :]
            return taken


_PAGES = _Pages()


def huge_zeros(shape: int | tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Return zeros, as `numpy.zeros`; large arrays share huge pages, if the system has them."""
    kind = np.dtype(dtype)
    sides = (shape,) if isinstance(shape, int) else shape
    size = prod(sides) * kind.itemsize
    if size < LEAST or not hasattr(mmap, "MADV_HUGEPAGE"):
        return np.zeros(shape, dtype=kind)
    return _PAGES.take(size).view(kind).reshape(sides)


def huge_copy(array: NDArray[Any], also_mapped: bool = False) -> NDArray[Any]:
    """Return the array in huge pages, with the same writeability.

    Small arrays are returned unchanged. So are arrays that are already in huge pages or in a mapped
    file, unless `also_mapped` is set.
    """
    if array.nbytes < LEAST or (_is_mapped(array) and not also_mapped):
        return array
    copy = huge_zeros(array.shape, array.dtype)
    # Byte for byte: an assignment would leave out the padding of records, which hashes read.
    copy.reshape(-1).view(np.uint8)[:] = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
    copy.setflags(write=array.flags.writeable)
    return copy


def _is_mapped(array: NDArray[Any]) -> bool:
    """Return whether an array is from `huge_zeros` or a mapped file, by its base's memory."""
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    return isinstance(getattr(base, "obj", base), mmap.mmap)


def huge_heap() -> dict[str, str]:
    """Return environment variables that put the heap of a process in huge pages; needs glibc.

    The user's own settings of the C library come last and take precedence.
    """
    own = os.environ.get(_TUNABLES)
    return {_TUNABLES: ":".join(["glibc.malloc.hugetlb=1", *([own] if own else [])])}


def trim() -> None:
    """Return free memory of the C library to the system; needs glibc."""
    give_back = getattr(_LIBC, "malloc_trim", None)
    if give_back is not None:
        give_back(ctypes.c_size_t(0))


def _map(size: int) -> NDArray[np.uint8]:
    memory = mmap.mmap(-1, size + PAGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    try:
        memory.madvise(mmap.MADV_HUGEPAGE)
    except OSError:
        pass  # this system has no huge pages; small pages work, too
    whole = np.frombuffer(memory, dtype=np.uint8)
    first = -whole.ctypes.data % PAGE
    return whole[first : first + size]


def forget(array: NDArray[Any]) -> None:
    """Release the whole pages of an array's memory: later reads return 0 or the old values.

    Only on Linux. The array must be contiguous and alone between its first and last byte.
    """
    size = mmap.PAGESIZE
    begin = array.ctypes.data
    first, last = -(-begin // size) * size, (begin + array.nbytes) // size * size
    if _LIBC is not None and first < last:
        _LIBC.madvise(ctypes.c_void_p(first), ctypes.c_size_t(last - first), mmap.MADV_DONTNEED)
