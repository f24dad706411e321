"""A job for hosts that adds up and fails on request, and processes that do it without Ray."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.parallel.hosts.host_process import TaskOutcome, serve
from tests.support.forked_processes import ForkedProcess

__all__ = ["ADD", "DOZE", "FAIL", "FALL", "TASKS", "TOIL", "TOTAL", "WRITE", "Processes", "ToyJob"]

TASKS = ("add", "write", "total", "fail", "fall", "doze", "toil")
ADD, WRITE, TOTAL, FAIL, FALL, DOZE, TOIL = range(len(TASKS))


class ToyJob:
    """Adds what it is given to a total, number by number."""

    def __init__(self, code: str = "toy", error: str = "") -> None:
        if error:
            raise ValueError(error)
        self.code = code
        self.fit(0)

    def fit(self, size: int) -> None:
        self.given = np.zeros(size)
        if size != len(getattr(self, "totals", ())) or not size:
            self.totals = np.zeros(size)

    def inputs(self, task: int, payload: Any) -> list[NDArray[Any]]:
        return [self.given] if task in (ADD, WRITE) else []

    def perform(self, task: int, payload: Any) -> TaskOutcome:
        if task == ADD:
            self.totals += self.given
        elif task == WRITE:
            self.totals[:] = self.given
        elif task == TOTAL:
            return TaskOutcome(float(self.totals.sum()), ())
        elif task == FAIL:
            self.totals += 1000.0
            raise ValueError("asked to fail")
        elif task == FALL and os.getpid() != payload:
            os._exit(3)
        elif task == DOZE and os.getpid() in payload:
            time.sleep(60.0)
        elif task == TOIL:
            until_s = time.monotonic() + payload
            while time.monotonic() < until_s:
                pass
        return TaskOutcome(None, [self.totals] if task in (ADD, WRITE) else ())

    def save(self) -> list[NDArray[Any]]:
        return [self.totals]

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        self.totals[:] = saved[0]


class Processes:
    """Hosts as processes of this machine; who has died is started again when somebody looks."""

    address = "127.0.0.1"

    def __init__(self, count: int, **recipe: Any) -> None:
        self._recipe = recipe
        self._count = count
        self.processes: list[ForkedProcess] = []
        self.words: str | None = None

    def start(self, place: tuple[str, int], secret: bytes) -> None:
        self.place, self.secret = place, secret
        self.processes = [self._start(number) for number in range(self._count)]

    def _start(self, number: int) -> ForkedProcess:
        told = json.dumps([self.place, self.secret.hex(), number, self._recipe])
        return ForkedProcess(["-m", __name__, told])

    def restart(self, number: int) -> None:
        self.processes[number].kill()
        self._revive()

    def trouble(self) -> str | None:
        self._revive()
        return self.words

    def _revive(self) -> None:
        for number, process in enumerate(self.processes):
            if process.poll() is not None:
                self.processes[number] = self._start(number)

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


if __name__ == "__main__":
    place, secret, number, recipe = json.loads(sys.argv[1])
    serve(partial(ToyJob, **recipe), tuple(place), bytes.fromhex(secret), number)
