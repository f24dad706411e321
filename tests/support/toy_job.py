"""A job that adds numbers in the worker processes of a pool; workers run this file as a program."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.parallel.processes.worker_loop import serve

# DOZE sleeps, TOIL computes, FALL kills the worker at one of `POINTS`, RUN_OUT runs out of memory.
TASKS = ("add", "total", "fail", "die", "doze", "toil", "run out", "fall")
ADD, TOTAL, FAIL, DIE, DOZE, TOIL, RUN_OUT, FALL = range(len(TASKS))

POINTS = ("begun", "half done", "done", "image begun")


AT_WORK, ENOUGH = (
    "at work",
    "enough",
)  # TOIL writes to the first file, and ends when the second exists


def toil(payload: Any) -> None:
    """Compute for `payload` s, or, if it is a folder, until a file there ends the task."""
    if isinstance(payload, str):
        with open(os.path.join(payload, AT_WORK), "wb", buffering=0) as heard:
            heard.write(b".")
        while not os.path.exists(os.path.join(payload, ENOUGH)):
            pass
        return
    end = time.perf_counter() + payload
    while time.perf_counter() < end:
        pass


class Fatal(np.ndarray[Any, Any]):
    """An array that kills the process that copies it."""

    def view(self, *_: Any, **__: Any) -> Any:
        os.kill(os.getpid(), signal.SIGKILL)


class Adder:
    def __init__(self) -> None:
        self.numbers = np.zeros(3, dtype=[("a", np.float64), ("b", np.int32)])
        self.more = np.zeros(0)  # each task replaces this array by a longer one
        self.falls_at = ""

    def on_idle(self) -> None:
        """Do nothing: there is no idle work."""

    def before_fork(self) -> None:
        """Do nothing: no memory is shared."""

    def perform(self, task: int, payload: Any) -> Any:
        if task == TOTAL:
            return [float(self.numbers["a"].sum()), len(self.more)]
        if task == FALL:
            self.falls_at = ""
            with suppress(FileNotFoundError):  # only the first worker that removes the file dies
                os.unlink(payload[1])
                self.falls_at = POINTS[payload[0]]
        self.pass_by("begun")
        self.numbers["a"][0] += 1.0
        self.pass_by("half done")
        self.numbers["a"][1:] += 1.0
        self.more = np.append(self.more, np.ones(1000))
        if task == FAIL:
            raise ValueError(f"as told: {payload}")
        if task == DIE:
            os.kill(os.getpid(), signal.SIGSEGV if payload is None else payload)
        if task == DOZE:
            time.sleep(payload)
        if task == TOIL:
            toil(payload)
        if task == RUN_OUT:
            raise MemoryError
        return None

    def pass_by(self, point: str) -> None:
        if self.falls_at == point:
            os.kill(os.getpid(), signal.SIGKILL)

    def save(self) -> list[NDArray[Any]]:
        self.pass_by("done")
        more = self.more.view(Fatal) if self.falls_at == "image begun" else self.more
        return [self.numbers, more]

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        self.numbers[:] = saved[0]
        self.more = saved[1].copy()


def make_jobs(message: Mapping[str, Any]) -> list[Adder]:
    if "fails" in message:
        raise RuntimeError(message["fails"])
    for file in message.get("dies_while", ()):
        with suppress(FileNotFoundError):  # each of these files makes one start of a worker fail
            os.unlink(file)
            os.kill(os.getpid(), message.get("dies_by", signal.SIGKILL))
    if "ends" in message:
        os._exit(message["ends"])
    return [Adder() for _ in range(message["workers"])]


if __name__ == "__main__":
    serve(make_jobs)
