"""Work of a toy job that goes on until something has been done to it, however fast the machine."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread

from tests.support.toy_job import AT_WORK, ENOUGH


@contextmanager
def toiling(
    folder: Path, workers: int, act: Callable[[], object], *, ends: bool = True
) -> Iterator[str]:
    """What to tell TOIL, so that `act` is called once when so many are at it.

    They are let go after that; without `ends`, at the end of the block.
    """
    os.mkfifo(folder / AT_WORK)
    heard = os.open(folder / AT_WORK, os.O_RDWR)  # so that nobody waits for the other end
    given_up = False

    def watch() -> None:
        for _ in range(workers):
            os.read(heard, 1)
        if not given_up:
            act()
        if ends:
            (folder / ENOUGH).touch()

    thread = Thread(target=watch)
    thread.start()
    try:
        yield str(folder)
    finally:
        given_up = True
        (folder / ENOUGH).touch()
        os.write(heard, bytes(workers))
        thread.join()
        os.close(heard)
