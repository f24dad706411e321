"""Files that are there whole or not at all, whenever the process or the machine stops.

A file is made in a draft, a folder of its own beside its place, which a lock ties to the process:
the next draft in the same place removes those whose process has ended. Where the file system knows
no locks, they stay.
"""

from __future__ import annotations

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


def write_whole(path: Path, content: bytes) -> None:
    """Write a file in the place of an older one, which stays as it is if that fails.

    Raises:
        OSError: it cannot be written; nothing is left behind.
    """
    with draft_folder(path.parent) as folder:
        draft = folder / path.name
        with draft.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    if os.name == "posix":  # else the name may be the old file's after a power cut
        parent = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(parent)
        finally:
            os.close(parent)


@contextmanager
def draft_folder(parent: Path) -> Iterator[Path]:
    """A folder in `parent` that ends with the block; if the process is killed, with the next one.

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
    """Remove what processes that were killed had begun to make in a folder."""
    if sys.platform == "win32":
        return
    with suppress(OSError):  # there is none, or nothing can be removed from it
        for name in os.listdir(parent):
            if name.startswith(_PREFIX):
                _remove_dead(parent / name)


def _remove_dead(folder: Path) -> None:
    try:
        lock = _locked(folder)
    except OSError:  # its process lives, another one removes it, or there are no locks here
        return
    try:
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)


def _made(parent: Path) -> tuple[Path, int | None]:
    """A new folder and its lock, which goes with the process however that ends."""
    while True:
        folder = Path(tempfile.mkdtemp(dir=parent, prefix=_PREFIX))
        if sys.platform == "win32":
            return folder, None
        try:
            lock = _locked(folder)
        except (BlockingIOError, FileNotFoundError):  # another process took it for a dead one's
            continue
        except OSError:  # this file system has no locks
            return folder, None
        if folder.exists():
            return folder, lock
        os.close(lock)


def _locked(folder: Path) -> int:
    """Descriptor of a folder that no other process has locked."""
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        raise
    return lock
