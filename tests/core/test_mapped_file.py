"""Files that are mapped into memory: arrays over them, and released memory."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.atomic_file import write_whole
from cavmarl.core.huge_pages import LEAST, huge_copy
from cavmarl.core.mapped_file import file_of, let_go, mapped

NUMBERS = np.arange(LEAST, dtype=np.int64)


def test_an_array_is_a_view_of_the_file_and_not_copied(tmp_path: Path) -> None:
    path = tmp_path / "numbers"
    write_whole(path, NUMBERS.tobytes())
    file = mapped(path)
    array = np.frombuffer(memoryview(file)[8:], np.int64)[1:].reshape(-1, 2)
    assert file_of(array) is file
    assert huge_copy(array) is array
    copy = huge_copy(array, also_mapped=True)
    assert file_of(copy) is None
    assert (copy == array).all()
    assert not copy.flags.writeable
    assert not array.flags.writeable
    write_whole(path, b"another one in its place")
    let_go(file)
    assert (array.reshape(-1) == NUMBERS[2:]).all()


def test_arrays_that_are_not_mapped_belong_to_no_file() -> None:
    assert file_of(NUMBERS) is None
    assert file_of(huge_copy(NUMBERS)) is None


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_mapped_files_take_no_memory_after_their_release(tmp_path: Path) -> None:
    path = tmp_path / "numbers"
    write_whole(path, NUMBERS.tobytes())
    file = mapped(path)
    array = np.frombuffer(file, np.int64)
    assert array.sum() == NUMBERS.sum()
    used = _resident_kib(path)
    let_go(file)
    assert used == NUMBERS.nbytes // 1024
    assert _resident_kib(path) == 0


def test_missing_and_empty_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        mapped(tmp_path / "none")
    (tmp_path / "empty").touch()
    with pytest.raises(ValueError, match="empty"):
        mapped(tmp_path / "empty")


def _resident_kib(path: Path) -> int:
    """Return the resident memory of a mapped file in KiB."""
    lines = Path("/proc/self/smaps").read_text(encoding="ascii").splitlines()
    at = next(n for n, line in enumerate(lines) if line.endswith(str(path)))
    return next(int(line.split()[1]) for line in lines[at:] if line.startswith("Rss:"))
