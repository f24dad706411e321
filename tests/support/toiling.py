"""Run the toy task TOIL until a test has acted, so that no test depends on the machine's speed."""

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
    """Yield the payload of TOIL; call `act` when this number of workers run the task.

    The workers finish the task after `act`, or at the end of the block if `ends` is false.
    """
    os.mkfifo(folder / AT_WORK)
    # If a FIFO is opened for reading and writing, open() does not wait for another process.
    heard = os.open(folder / AT_WORK, os.O_RDWR)
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
