"""Draft folders are removed at the end of their block or, after a kill, by the next draft."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from cavmarl.core import atomic_file
from cavmarl.core.atomic_file import draft_folder, write_whole

_MAKE_AND_WAIT = (
    "import sys, pathlib; from cavmarl.core.atomic_file import draft_folder\n"
    "with draft_folder(pathlib.Path(sys.argv[1])) as folder:\n"
    "    (folder / 'half').write_bytes(b'1')\n"
    "    print(folder, flush=True); sys.stdin.read()\n"
)


def _drafts(folder: Path) -> set[Path]:
    return set(folder.glob(".build-*"))


def test_the_next_draft_removes_drafts_of_killed_processes_only(
    tmp_path: Path,
) -> None:
    dead, living = (
        subprocess.Popen(
            [sys.executable, "-c", _MAKE_AND_WAIT, str(tmp_path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    )
    try:
        assert dead.stdout is not None
        assert living.stdout is not None
        left, held = Path(dead.stdout.readline().strip()), Path(living.stdout.readline().strip())
        dead.kill()
        dead.wait()
        assert _drafts(tmp_path) == {left, held}
        write_whole(tmp_path / "file", b"content")
        assert _drafts(tmp_path) == {held}
        assert (held / "half").read_bytes() == b"1"
        living.communicate("")
        assert living.returncode == 0
        assert list(tmp_path.iterdir()) == [tmp_path / "file"]
    finally:
        for process in (dead, living):
            process.kill()
            process.communicate()


def test_a_locked_draft_of_the_same_process_is_not_removed(tmp_path: Path) -> None:
    with draft_folder(tmp_path) as first, draft_folder(tmp_path) as second:
        assert _drafts(tmp_path) == {first, second}
    assert not _drafts(tmp_path)


def test_drafts_of_concurrent_threads_do_not_remove_each_other(tmp_path: Path) -> None:
    def make(number: int) -> None:
        try:
            for turn in range(40):
                with draft_folder(tmp_path) as folder:
                    (folder / "half").write_bytes(b"1")
                    (folder / "half").replace(tmp_path / f"{number}-{turn}")
        except OSError as error:
            failed.append(error)

    failed: list[OSError] = []
    makers = [threading.Thread(target=make, args=(number,)) for number in range(6)]
    for maker in makers:
        maker.start()
    for maker in makers:
        maker.join()
    assert not failed
    assert len(list(tmp_path.iterdir())) == 6 * 40


def test_a_draft_that_is_removed_before_it_is_locked_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make, made = atomic_file.tempfile.mkdtemp, []

    def make_and_remove_the_first(*args: object, **options: object) -> str:
        name: str = make(*args, **options)  # type: ignore[call-overload]
        made.append(name)
        if len(made) == 1:
            os.rmdir(name)
        return name

    monkeypatch.setattr(atomic_file.tempfile, "mkdtemp", make_and_remove_the_first)
    with draft_folder(tmp_path) as folder:
        assert [str(folder)] == made[1:]
        assert folder.is_dir()


def test_without_locks_files_are_written_and_no_draft_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse_the_lock(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse_the_lock)
    other = tmp_path / ".build-other"
    other.mkdir()
    write_whole(tmp_path / "file", b"content")
    assert (tmp_path / "file").read_bytes() == b"content"
    assert _drafts(tmp_path) == {other}


def test_a_failed_write_keeps_the_older_file_and_leaves_no_draft(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def report_a_full_disk(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "file"
    write_whole(path, b"old")
    monkeypatch.setattr(os, "fsync", report_a_full_disk)
    with pytest.raises(OSError, match="No space left"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_only_this_module_makes_temporary_files_beside_their_targets() -> None:
    package = Path(atomic_file.__file__).parents[1]
    beside = re.compile(r"(TemporaryDirectory|NamedTemporaryFile|mkdtemp|mkstemp)\([^)]*dir=")
    found = [path for path in package.rglob("*.py") if beside.search(path.read_text("utf-8"))]
    assert found == [Path(atomic_file.__file__)]
