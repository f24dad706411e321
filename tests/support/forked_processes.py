"""Processes of pools as forks of one that has loaded the kernels: each starts in milliseconds.

Elsewhere each begins as a Python of its own, which takes more than a second. Tests that look at
that ask for the fixture `fresh_processes`.
"""

from __future__ import annotations

import fcntl
import os
import runpy
import subprocess
import sys
import warnings
from collections.abc import Mapping, Sequence
from multiprocessing.reduction import DupFd
from typing import IO, Any

from cavmarl.core.processes import start_python
from tests.support.world_hosts import FORKS

__all__ = ["ForkedProcess", "start_forked"]


class ForkedProcess:
    """What of `subprocess.Popen` pools use."""

    def __init__(
        self,
        module: str,
        arguments: Sequence[str],
        descriptors: Sequence[int] = (),  # that it gets, by the same numbers
        variables: Mapping[str, str] | None = None,  # of its environment; None: those here
        with_stdin: bool = False,
    ) -> None:
        self.stdin: IO[str] | None = None
        variables = dict(os.environ if variables is None else variables)
        stdin = os.open(os.devnull, os.O_RDONLY)
        if with_stdin:
            os.close(stdin)
            stdin, ours = os.pipe()
            self.stdin = os.fdopen(ours, "w")
        given = {0: stdin, 1: 1, 2: 2} | {number: number for number in descriptors}
        passed = {number: DupFd(there) for number, there in given.items()}
        self._process = FORKS.Process(
            target=_run,
            args=(module, list(arguments), passed, variables, os.getpid()),
            daemon=True,
        )
        self._process.start()
        os.close(stdin)

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired("a forked process", timeout or 0.0)
        return self.returncode

    def kill(self) -> None:
        self._process.kill()


def start_forked(words: Sequence[str], **options: Any) -> Any:
    """In the place of `start_python`; words that run no module of ours go there."""
    if words[0] != "-m" or not words[1].startswith("cavmarl."):
        return start_python(words, **options)
    return ForkedProcess(
        words[1],
        words[2:],
        options.get("pass_fds", ()),
        {**os.environ, **(options.get("env") or {})},
        options.get("stdin") == subprocess.PIPE,
    )


def _run(
    module: str,
    arguments: list[str],
    passed: dict[int, Any],
    variables: dict[str, str],
    caller: int,
) -> None:
    free = max(passed) + 1
    moved = {}
    for number, descriptor in passed.items():
        there = descriptor.detach()
        moved[number] = fcntl.fcntl(there, fcntl.F_DUPFD, free)
        os.close(there)
    for number, there in moved.items():
        os.dup2(there, number)
        os.close(there)
    os.environ.clear()
    os.environ.update(variables)
    own, asked = os.getpid(), os.getppid
    # Between the two is the process that has forked this one.
    os.getppid = lambda: caller if os.getpid() == own else asked()
    sys.argv = [module, *arguments]
    sys.stdin = open(0, closefd=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # it has been imported before
        runpy.run_module(module, run_name="__main__")
