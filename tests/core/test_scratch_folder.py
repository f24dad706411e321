"""Temporary files are deleted when their process ends, or else when the next process begins."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from cavmarl.core.scratch_folder import PREFIX, remove_abandoned, scratch_folder

PROGRAM = """
import tempfile, time
from cavmarl.core.scratch_folder import scratch_folder
with scratch_folder():
    print(tempfile.mkdtemp(prefix="cavmarl-files-"), flush=True)
    time.sleep(60.0)
"""


@pytest.fixture
def base(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path


def test_temporary_files_are_deleted_at_the_end_of_the_block(base: Path) -> None:
    with scratch_folder() as folder:
        assert Path(tempfile.mkdtemp()).parent == folder
        assert os.environ["TMPDIR"] == str(folder)
        remove_abandoned(base)
        assert folder.is_dir()
    assert os.environ["TMPDIR"] == str(base)
    assert not list(base.iterdir())


def test_the_next_process_deletes_the_folder_of_a_killed_process(base: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    files = Path(process.stdout.readline().strip())
    with scratch_folder():
        assert files.is_dir()  # the process that owns the files still runs
    process.kill()
    process.wait()
    process.stdout.close()
    assert files.is_dir()
    with scratch_folder() as folder:
        assert list(base.iterdir()) == [folder]


def test_links_files_and_other_folders_are_not_deleted(base: Path) -> None:
    (base / "kept").mkdir()
    (base / f"{PREFIX}link").symlink_to(base / "kept")
    (base / f"{PREFIX}file").touch()
    remove_abandoned(base)
    assert len(list(base.iterdir())) == 3
