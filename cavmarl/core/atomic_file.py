"""Files that are either complete or absent, even if the process or the machine stops.

A file is written in a draft folder beside its destination. While the process lives, it holds a lock
on that folder. The next draft in the same place removes folders whose process has ended. If the
file system has no locks, these folders stay.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

if sys.platform != "win32":
    import fcntl

_PREFIX = ".build-"


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, hex; raises OSError if the file cannot be read."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_whole(path: Path, content: bytes) -> None:
    """Replace a file; if that fails, the old file does not change.

    Raises:
        OSError: the file cannot be written; nothing is left behind.
    """
    with draft_folder(path.parent) as folder:
        draft = folder / path.name
        with draft.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    if os.name == "posix":  # without this, the old file may return after a power cut
        parent = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(parent)
        finally:
            os.close(parent)


@contextmanager
def draft_folder(parent: Path) -> Iterator[Path]:
    """Yield a new folder in `parent`; it is removed at the end, or by a later call after a kill.

    Raises:
        OSError: `parent` cannot be written.
    """
    remove_dead_drafts(parent)
    folder, lock = _made(parent)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def remove_dead_drafts(parent: Path) -> None:
    """Remove the drafts in a folder that belong to processes which have ended."""
    if sys.platform == "win32":
        return
    with suppress(OSError):  # the folder does not exist, or cannot be changed
        for name in os.listdir(parent):
            if name.startswith(_PREFIX):
                _remove_dead(parent / name)


def _remove_dead(folder: Path) -> None:
    try:
        lock = _locked(folder)
    except OSError:  # its process is alive, another process removes it, or locks do not exist here
        return
    try:
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)


def _made(parent: Path) -> tuple[Path, int | None]:
    """Return a new folder and its lock, which the system releases when the process ends."""
    while True:
        folder = Path(tempfile.mkdtemp(dir=parent, prefix=_PREFIX))
        if sys.platform == "win32":
            return folder, None
        try:
            lock = _locked(folder)
        except (BlockingIOError, FileNotFoundError):  # another process has removed it
            continue
        except OSError:  # this file system has no locks
            return folder, None
        if folder.exists():
            return folder, lock
        os.close(lock)


def _locked(folder: Path) -> int:
    """Return a descriptor of a folder; raises an OSError if another process has locked it."""
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        raise
    return lock
