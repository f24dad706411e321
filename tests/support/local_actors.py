"""Processes of this machine that replace the actors of `RayActors`."""

from __future__ import annotations

import importlib
import multiprocessing
from multiprocessing.process import BaseProcess
from typing import Any

__all__ = ["FORKS", "LocalActors"]

# Each process is a fork of a process with loaded kernels, because a fresh start takes seconds.
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(["tests.support.loaded_kernels"])


class LocalActors:
    """At most two processes and one spare process. Dead processes are started again."""

    address = "127.0.0.1"

    def __init__(self, main: Any, workers: int | None, at_most: int) -> None:
        self.workers = min(2, at_most) if workers is None else workers
        self._main = main
        self.processes: list[BaseProcess] = []

    def start(self, place: tuple[str, int], secret: bytes) -> None:
        self._arguments = (self._main.__module__, self._main.__name__, place, secret)
        self.processes = [self._start(number) for number in range(self.workers + 1)]

    def _start(self, number: int) -> BaseProcess:
        process = FORKS.Process(target=_serve, args=(*self._arguments, number), daemon=True)
        process.start()
        return process

    def restart(self, number: int) -> None:
        self.processes[number].kill()
        self.trouble()

    def trouble(self) -> str | None:
        for number, process in enumerate(self.processes):
            if not process.is_alive():
                self.processes[number] = self._start(number)
        return None

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.join()


def _serve(module: str, function: str, place: tuple[str, int], secret: bytes, number: int) -> None:
    getattr(importlib.import_module(module), function)(place, secret, number)
