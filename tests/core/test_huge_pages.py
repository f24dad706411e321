"""Arrays in huge pages behave like all other arrays."""

from __future__ import annotations

import gc
import mmap
import weakref

import numpy as np
import pytest

from cavmarl.core.huge_pages import LEAST, PAGE, huge_copy, huge_heap, huge_zeros

RECORD = np.dtype([("x", np.float64), ("on", np.bool_)], align=True)


@pytest.mark.parametrize("size", [1, LEAST // 8 - 1, LEAST // 8, PAGE // 8, 3 * PAGE // 8 + 5])
def test_huge_arrays_are_zero_and_share_no_byte(size: int) -> None:
    """A value that is written to one array does not appear in another array."""
    first, second = huge_zeros(size), huge_zeros((size, 1), dtype=np.int64)
    assert first.shape == (size,)
    assert second.shape == (size, 1)
    assert not first.any()
    first[:] = 1.0
    assert not second.any()
    assert not np.shares_memory(first, second)


def test_records_in_huge_pages_are_aligned() -> None:
    """Large arrays start on a cache line, and their records are aligned."""
    for size in (7000, 7001, 300_000):
        array = huge_zeros(size, dtype=RECORD)
        assert array.flags.aligned
        assert array.ctypes.data % 64 == 0


def test_a_copy_has_every_byte_and_the_same_write_protection() -> None:
    """Padding is copied too, because hashes of maps include it."""
    array = np.frombuffer(bytes(range(256)) * 16 * 64, dtype=RECORD)
    copy = huge_copy(array)
    assert copy.tobytes() == array.tobytes()
    assert not copy.flags.writeable
    assert not np.shares_memory(copy, array)
    small = np.zeros(3)
    assert huge_copy(small) is small


@pytest.mark.skipif(not hasattr(mmap, "MADV_HUGEPAGE"), reason="there are no huge pages")
def test_arrays_in_huge_pages_are_not_copied() -> None:
    """This lets copies of a map share the tables that are equal."""
    array = huge_zeros(2 * LEAST // 8)
    assert huge_copy(array) is array
    part = array[1:]
    assert huge_copy(part) is part


def test_memory_is_freed_with_its_arrays() -> None:
    """No reference to the pages remains after the last array is deleted."""
    array = huge_zeros(4 * PAGE // 8)
    memory = array
    while isinstance(memory, np.ndarray):
        assert memory.base is not None
        memory = memory.base
    gone = weakref.ref(_mapping(memory))
    del memory, array
    huge_zeros(4 * PAGE // 8)  # the module refers to the unused rest of the newest pages
    gc.collect()
    assert gone() is None


def test_arrays_work_without_huge_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without huge pages, NumPy allocates the arrays."""
    monkeypatch.delattr(mmap, "MADV_HUGEPAGE")
    assert huge_zeros(PAGE).base is None


def _mapping(memory: object) -> mmap.mmap:
    assert isinstance(memory, memoryview | mmap.mmap)
    found = memory.obj if isinstance(memory, memoryview) else memory
    assert isinstance(found, mmap.mmap)
    return found


@pytest.mark.parametrize("own", ["", "glibc.malloc.hugetlb=0"])
def test_the_heap_is_in_huge_pages_unless_the_environment_sets_otherwise(
    monkeypatch: pytest.MonkeyPatch, own: str
) -> None:
    monkeypatch.setenv("GLIBC_TUNABLES", own)
    first, *more = huge_heap()["GLIBC_TUNABLES"].split(":")
    assert first == "glibc.malloc.hugetlb=1"
    assert more == ([own] if own else [])
