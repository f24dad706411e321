"""Makes arrays in huge pages: a tick reads many places, and each small page costs a look-up.

In a virtual machine a page that the processor does not know by heart costs two walks through
tables. Linux gives pages of 2 MiB on request, where they are not switched off
(`/sys/kernel/mm/transparent_hugepage/enabled`); elsewhere arrays are NumPy's own.
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

PAGE = 1 << 21  # bytes
LEAST = 1 << 16  # bytes of an array that is worth it
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None
_TUNABLES = "GLIBC_TUNABLES"
_LINE = 64  # bytes of a cache line: no two arrays share one


class _Pages:
    """Whole pages, which arrays take one after the other; they go with the last of them."""

    def __init__(self) -> None:
        self._bytes = np.zeros(0, dtype=np.uint8)
        self._lock = threading.Lock()

    def take(self, size: int) -> NDArray[np.uint8]:
        """So many bytes, all 0."""
        with self._lock:
            if size > self._bytes.size:
                self._bytes = _map(-(-size // PAGE) * PAGE)
            taken = self._bytes[:size]
            self._bytes = self._bytes[-(-size // _LINE) * _LINE :]
            return taken


_PAGES = _Pages()


def huge_zeros(shape: int | tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """As `numpy.zeros`; a large array shares huge pages with others, where there are any."""
    kind = np.dtype(dtype)
    sides = (shape,) if isinstance(shape, int) else shape
    size = prod(sides) * kind.itemsize
    if size < LEAST or not hasattr(mmap, "MADV_HUGEPAGE"):
        return np.zeros(shape, dtype=kind)
    return _PAGES.take(size).view(kind).reshape(sides)


def huge_copy(array: NDArray[Any], also_mapped: bool = False) -> NDArray[Any]:
    """The same array in huge pages, as writable as it was; a small one is not copied.

    Nor is one that lies in them, or in a file that is mapped, unless `also_mapped` says so.
    """
    if array.nbytes < LEAST or (_is_mapped(array) and not also_mapped):
        return array
    copy = huge_zeros(array.shape, array.dtype)
    # Byte for byte: an assignment would leave out the padding of records, which hashes read.
    copy.reshape(-1).view(np.uint8)[:] = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
    copy.setflags(write=array.flags.writeable)
    return copy


def _is_mapped(array: NDArray[Any]) -> bool:
    """Whether it has come out of `huge_zeros` or of a file, by the memory that its base is of."""
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    return isinstance(getattr(base, "obj", base), mmap.mmap)


def huge_heap() -> dict[str, str]:
    """With these variables of its environment a process has its heap in huge pages; glibc can.

    What the user has set of the C library comes last, and so counts.
    """
    own = os.environ.get(_TUNABLES)
    return {_TUNABLES: ":".join(["glibc.malloc.hugetlb=1", *([own] if own else [])])}


def trim() -> None:
    """Give memory of the C library that is free back to the system; glibc alone can."""
    give_back = getattr(_LIBC, "malloc_trim", None)
    if give_back is not None:
        give_back(ctypes.c_size_t(0))


def _map(size: int) -> NDArray[np.uint8]:
    memory = mmap.mmap(-1, size + PAGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    try:
        memory.madvise(mmap.MADV_HUGEPAGE)
    except OSError:
        pass  # a kernel without them: the memory is as good in small pages
    whole = np.frombuffer(memory, dtype=np.uint8)
    first = -whole.ctypes.data % PAGE
    return whole[first : first + size]


def forget(array: NDArray[Any]) -> None:
    """Give the memory of an array back, as far as it has whole pages: it reads as 0 or as it was.

    Linux alone can; the array is contiguous, and nothing else lies between its first and last byte.
    """
    size = mmap.PAGESIZE
    begin = array.ctypes.data
    first, last = -(-begin // size) * size, (begin + array.nbytes) // size * size
    if _LIBC is not None and first < last:
        _LIBC.madvise(ctypes.c_void_p(first), ctypes.c_size_t(last - first), mmap.MADV_DONTNEED)
