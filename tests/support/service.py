"""A coordination service and its nodes, each in its own process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cavmarl.client import Client
from tests.support.forked_processes import ForkedProcess

__all__ = ["Cluster", "RunningService", "running_service"]


@dataclass
class RunningService:
    """The command `cavmarl serve` in its own process."""

    process: Any
    url: str
    secret: str  # secret of the admin
    store: str | Path

    def client(self, secret: str = "", **options: Any) -> Client:
        return Client(self.url, secret or self.secret, **options)

    def grant(self, name: str, role: str) -> str:
        with self.client() as admin:
            return str(admin.post("/identities", {"name": name, "role": role})["secret"])

    def kill(self) -> None:
        self.process.kill()
        self._end()

    def terminate(self) -> None:
        self.process.send_signal(signal.SIGTERM)
        self._end()

    def _end(self) -> None:
        self.process.wait()
        self.process.stdout.close()

    def start_again(self, *options: str) -> None:
        """Start the service again with the same port and store."""
        port = self.url.rsplit(":", 1)[1]
        words = ["-m", "cavmarl", "serve", "--port", port, "--store", str(self.store), *options]
        self.process = ForkedProcess(words, stdout=subprocess.PIPE, text=True)
        assert self.url in self.process.stdout.readline()


@contextmanager
def running_service(
    store: str | Path, *options: str, fresh: bool = False
) -> Iterator[RunningService]:
    """Run a service with a new store within the block.

    The process is a fork of a process with loaded kernels, or a new interpreter if `fresh` is true.
    """
    words = ["-m", "cavmarl", "serve", "--port", "0", "--store", str(store), *options]
    process: Any
    if fresh:
        command = [sys.executable, *words]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    else:
        process = ForkedProcess(words, stdout=subprocess.PIPE, text=True)
    running = RunningService(process, "", "", store)
    try:
        running.url = process.stdout.readline().split()[1].rstrip(",")
        running.secret = process.stdout.readline().split()[-1]
        yield running
    finally:
        if running.process.poll() is None:
            running.terminate()


@dataclass
class Cluster:
    """The node processes of a running service, which are forks of a process with loaded kernels."""

    service: RunningService
    processes: dict[str, ForkedProcess] = field(default_factory=dict)

    def start(self, *names: str, secret: str = "", options: Sequence[str] = ()) -> None:
        for name in names:
            self._begin(name, secret or self.service.grant(name, "node"), options)
        for name in names:
            stdout = self.processes[name].stdout
            assert stdout is not None
            assert name in stdout.readline()

    def _begin(self, name: str, secret: str, options: Sequence[str]) -> None:
        words = ["-m", "cavmarl", "node", "--service", self.service.url]
        words += ["--name", name, "--snapshot", "idle", *options]
        environment = {**os.environ, "CAVMARL_SECRET": secret}
        self.processes[name] = ForkedProcess(
            words, env=environment, stdout=subprocess.PIPE, text=True
        )

    def stop(self) -> None:
        for process in self.processes.values():
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()
