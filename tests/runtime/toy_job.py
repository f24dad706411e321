"""A job that adds up, for the processes of a pool; run as a program."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.runtime.worker import serve

TASKS = ("add", "total", "fail", "die", "doze", "toil", "run out")
ADD, TOTAL, FAIL, DIE, DOZE, TOIL, RUN_OUT = range(len(TASKS))


class Adder:
    def __init__(self) -> None:
        self.numbers = np.zeros(3, dtype=[("a", np.float64), ("b", np.int32)])
        self.more = np.zeros(0)  # another one each time

    def prepare(self) -> None:
        """Nothing is shared."""

    def perform(self, task: int, letter: Any) -> Any:
        if task == TOTAL:
            return [float(self.numbers["a"].sum()), len(self.more)]
        self.numbers["a"] += 1.0
        self.more = np.append(self.more, np.ones(1000))
        if task == FAIL:
            raise ValueError(f"as told: {letter}")
        if task == DIE:
            os.kill(os.getpid(), signal.SIGSEGV if letter is None else letter)
        if task == DOZE:
            time.sleep(letter)
        if task == TOIL:
            end = time.perf_counter() + letter
            while time.perf_counter() < end:
                pass
        if task == RUN_OUT:
            raise MemoryError
        return None

    def save(self) -> list[NDArray[Any]]:
        return [self.numbers, self.more]

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        self.numbers[:] = saved[0]
        self.more = saved[1].copy()


def make_jobs(recipe: Mapping[str, Any]) -> list[Adder]:
    if "fails" in recipe:
        raise RuntimeError(recipe["fails"])
    if "ends" in recipe:
        os._exit(recipe["ends"])
    return [Adder() for _ in range(recipe["workers"])]


if __name__ == "__main__":
    serve(make_jobs)
