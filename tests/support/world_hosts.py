"""Hosts of worlds as processes of this machine: what Ray's actors do, without Ray."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from collections.abc import Callable
from typing import Any

from tests.support.toy_hosts import ROOT

__all__ = ["WorldHosts"]


class WorldHosts:
    """In the place of `RayActors`: two at most, and one to spare; who dies is started again."""

    address = "127.0.0.1"

    def __init__(
        self, main: Any, recipe: Callable[[int], str], workers: int | None, at_most: int
    ) -> None:
        self.workers = min(2, at_most) if workers is None else workers
        self._main = f"{main.__module__} {main.__name__}"
        self._recipe = recipe(self.workers)
        self.processes: list[subprocess.Popen[bytes]] = []

    def start(self, place: tuple[str, int], secret: bytes) -> None:
        self._told = [self._main, self._recipe, place, secret.hex()]
        self.processes = [self._start(number) for number in range(self.workers + 1)]

    def _start(self, number: int) -> subprocess.Popen[bytes]:
        told = json.dumps([*self._told, number])
        return subprocess.Popen([sys.executable, "-m", __name__, told], cwd=ROOT)

    def restart(self, number: int) -> None:
        self.processes[number].kill()
        self.trouble()

    def trouble(self) -> str | None:
        for number, process in enumerate(self.processes):
            if process.poll() is not None:
                self.processes[number] = self._start(number)
        return None

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


if __name__ == "__main__":
    name, recipe, place, secret, number = json.loads(sys.argv[1])
    module, function = name.split()
    getattr(importlib.import_module(module), function)(
        recipe, tuple(place), bytes.fromhex(secret), number
    )
