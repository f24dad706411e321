"""Shared memory in huge pages: its content, its sharing and its placement."""

from __future__ import annotations

import gc
import os
import re
from pathlib import Path

import numpy as np
import pytest

from cavmarl.parallel.memory import shared_huge_pages
from cavmarl.parallel.memory.shared_huge_pages import (
    HUGE_BYTES,
    MOST_BYTES,
    collapse_heap,
    huge_shared_zeros,
)

MAPS = Path("/proc/self/maps")
ROW = np.dtype([("id", np.int64), ("place", np.float32, (3,))], align=True)


def mapped(address: int) -> dict[str, int]:
    """Return the entries of smaps for the mapping at an address; empty if there is no mapping."""
    text = Path("/proc/self/smaps").read_text(encoding="ascii")
    found = re.search(rf"^{address:x}-.*\n((?:\w+: .*\n)+)", text, re.MULTILINE)
    lines = re.findall(r"^(\w+): +(\d+) kB$", "" if found is None else found[1], re.MULTILINE)
    return {name: 1024 * int(number) for name, number in lines}


def test_a_large_array_is_zero_and_aligned_to_huge_pages() -> None:
    array = huge_shared_zeros((2, 3, HUGE_BYTES // 8), ROW)
    assert array.shape == (2, 3, HUGE_BYTES // 8)
    assert array.dtype == ROW
    assert array.ctypes.data % HUGE_BYTES == 0
    assert not array["id"].any()
    assert not array["place"].any()


@pytest.mark.parametrize("size", [0, 5, HUGE_BYTES - 1, HUGE_BYTES, 3 * HUGE_BYTES + 7])
def test_arrays_of_any_size_keep_their_content(size: int) -> None:
    array = huge_shared_zeros(size, np.uint8)
    expected = np.arange(size, dtype=np.uint8)
    array[:] = expected
    assert array.tobytes() == expected.tobytes()


@pytest.mark.parametrize("can_collapse", [True, False])
def test_a_forked_process_writes_to_the_same_array(
    can_collapse: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not can_collapse:  # as on a system without MADV_COLLAPSE
        monkeypatch.setattr(shared_huge_pages, "COLLAPSE", -1)
    array = huge_shared_zeros(HUGE_BYTES, np.int64)
    pid = os.fork()
    if pid == 0:
        array[:] = 7
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert (array == 7).all()
    if not can_collapse:
        assert mapped(array.ctypes.data)["ShmemPmdMapped"] == 0


def test_all_pages_of_an_array_are_huge_or_none() -> None:
    array = huge_shared_zeros(3 * HUGE_BYTES + 9, np.uint8)
    array[:] = 1
    large = mapped(array.ctypes.data)["ShmemPmdMapped"]
    assert large == (3 * HUGE_BYTES if has_huge_pages() else 0)


def has_huge_pages() -> bool:
    """Return whether this system gives huge pages on request."""
    setting = Path("/sys/kernel/mm/transparent_hugepage/shmem_enabled")
    version = tuple(map(int, os.uname().release.split(".")[:2]))
    return version >= (6, 1) and setting.is_file() and "[deny]" not in setting.read_text()


def test_a_very_large_array_takes_memory_only_where_it_is_written() -> None:
    array = huge_shared_zeros(MOST_BYTES + 1, np.uint8)
    before = mapped(array.ctypes.data)["Rss"]
    array[:HUGE_BYTES] = 1
    after = mapped(array.ctypes.data)["Rss"]
    assert before == 0
    assert HUGE_BYTES <= after < 2 * HUGE_BYTES


def test_memory_of_a_deleted_array_is_freed() -> None:
    array = huge_shared_zeros(4 * HUGE_BYTES, np.uint8)
    view, address = array[5:], array.ctypes.data
    del array
    gc.collect()
    assert mapped(address)
    del view
    gc.collect()
    assert not mapped(address)


def test_missing_memory_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_huge_pages, "MOST_BYTES", 1 << 62)
    with pytest.raises(MemoryError, match=f"no room for {1 << 60} bytes"):
        huge_shared_zeros(1 << 60, np.uint8)


def test_a_heap_in_huge_pages_keeps_its_content() -> None:
    words = [bytes([n % 251]) * 100 for n in range(100_000)]  # small objects are in the heap
    collapse_heap()
    if has_huge_pages():
        heap = int(re.search(r"^(\w+)-.*\[heap\]$", MAPS.read_text(), re.MULTILINE)[1], 16)
        assert mapped(heap)["AnonHugePages"] >= HUGE_BYTES
    assert words == [bytes([n % 251]) * 100 for n in range(100_000)]
