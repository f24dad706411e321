"""Processes that are forks of a process with loaded kernels, so they start in milliseconds.

Outside of tests, each process is a new interpreter, whose start takes more than a second. Tests of
such starts use the fixture `fresh_processes`.
"""

from __future__ import annotations

import fcntl
import os
import runpy
import subprocess
import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from multiprocessing.reduction import DupFd
from typing import IO, Any

from cavmarl.core.processes import start_python
from cavmarl.evaluate.subprocess_calls import PROGRAM
from cavmarl.traffic.sumo import sumo_child
from tests.support.local_actors import FORKS

__all__ = ["FORKS", "ForkedProcess", "start_forked"]


# Environment variables that libsumo sets when it is imported.
_SET_BY_LIBSUMO = ("SUMO_HOME", "PROJ_LIB", "PROJ_DATA")


class ForkedProcess:
    """The part of `subprocess.Popen` that pools and tests use.

    `words`: arguments of a Python interpreter: `-m` and a module, `-c` and a program, or a file;
    then the arguments of the program.
    `env`: environment variables; None means the variables of this process.
    """

    def __init__(
        self,
        words: Sequence[str],
        *,
        env: Mapping[str, str] | None = None,
        stdin: int | None = None,
        stdout: int | IO[bytes] | None = None,
        stderr: IO[bytes] | None = None,
        pass_fds: Sequence[int] = (),
        text: bool = False,
    ) -> None:
        self.stdin: IO[Any] | None
        self.stdout: IO[Any] | None
        self.stdin, read = _pipe_to(text) if stdin == subprocess.PIPE else (None, _nothing())
        self.stdout, write = _pipe_from(text) if stdout == subprocess.PIPE else (None, os.dup(1))
        if stdout == subprocess.DEVNULL:
            os.dup2(_nothing(), write)
        elif stdout is not None and not isinstance(stdout, int):
            os.dup2(stdout.fileno(), write)
        errors = 2 if stderr is None else stderr.fileno()
        given = {0: read, 1: write, 2: errors} | {number: number for number in pass_fds}
        passed = {number: DupFd(there) for number, there in given.items()}
        variables = dict(os.environ if env is None else env)
        self._process = FORKS.Process(
            target=_run, args=(list(words), passed, variables, os.getpid()), daemon=True
        )
        self._process.start()
        os.close(read)
        os.close(write)

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

    def send_signal(self, number: int) -> None:
        if self.returncode is None:
            os.kill(self.pid, number)

    def __enter__(self) -> ForkedProcess:
        return self

    def __exit__(self, *_: object) -> None:
        for pipe in (self.stdin, self.stdout):
            if pipe is not None:
                pipe.close()
        self.wait()


def start_forked(words: Sequence[str], env: Mapping[str, str] | None = None, **options: Any) -> Any:
    """Start programs of cavmarl or the tests as forks, and other programs with `start_python`."""
    ours = words[0] == "-m" and words[1].startswith(("cavmarl.", "tests."))
    if ours or words == ["-c", PROGRAM] or words[0] == sumo_child.__file__:
        return ForkedProcess(words, env={**os.environ, **(env or {})}, **options)
    return start_python(words, env=env, **options)


def _nothing() -> int:
    return os.open(os.devnull, os.O_RDWR)


def _pipe_to(text: bool) -> tuple[IO[Any], int]:
    read, write = os.pipe()
    return os.fdopen(write, "w" if text else "wb"), read


def _pipe_from(text: bool) -> tuple[IO[Any], int]:
    read, write = os.pipe()
    return os.fdopen(read, "r" if text else "rb"), write


def _run(words: list[str], passed: dict[int, Any], variables: dict[str, str], caller: int) -> None:
    free = max(passed) + 1
    moved = {}
    for number, descriptor in passed.items():
        there = descriptor.detach()
        moved[number] = fcntl.fcntl(there, fcntl.F_DUPFD, free)
        os.close(there)
    for number, there in moved.items():
        os.dup2(there, number)
        os.close(there)
    of_libsumo = {name: os.environ[name] for name in _SET_BY_LIBSUMO if name in os.environ}
    os.environ.clear()
    os.environ.update(of_libsumo | variables)
    own, asked = os.getpid(), os.getppid
    # The real parent is the fork server; report the caller instead.
    os.getppid = lambda: caller if os.getpid() == own else asked()
    sys.stdin = open(0, closefd=False)
    sys.stdout = sys.__stdout__ = open(1, "w", closefd=False)  # type: ignore[misc]
    if words[0].endswith(".py"):
        sys.argv = words
        runpy.run_path(words[0], run_name="__main__")
        return
    how, what, *arguments = words
    if how == "-c":
        sys.argv = [how, *arguments]
        exec(what, {"__name__": "__main__"})
        return
    spec = find_spec(what)
    if spec is not None and spec.submodule_search_locations is not None:
        spec = find_spec(f"{what}.__main__")
    assert spec is not None
    assert spec.origin is not None
    sys.argv = [spec.origin, *arguments]
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", RuntimeWarning
        )  # runpy warns because the module is already imported
        runpy.run_module(what, run_name="__main__")
