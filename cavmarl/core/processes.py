"""Child processes; on Linux, they always end with the process that started them.

Ctrl-C in a terminal only interrupts the parent, which then ends its children.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import IO, Any

from cavmarl.core.errors import WorkerError

LAST_WORDS = 2000

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None


def is_fork(pid: int) -> bool:
    """Return whether this process is a fork of the process `pid`."""
    return os.getpid() != pid


def refuse_fork(pid: int, things: str) -> None:
    """Raise an error if this process is a fork of process `pid`, which made `things`.

    Raises:
        WorkerError: this is a fork. Both processes would use the same connection or file; `things`
            describes it in the message.
    """
    if is_fork(pid):
        raise WorkerError(
            f"{things} belong to process {pid}, and this process is a fork of it; make the "
            "environment here, after the fork"
        )


def end_process(process: subprocess.Popen[Any], within_s: float) -> None:
    """Wait for a process, and kill it if it has not ended by itself within this time."""
    try:
        process.wait(within_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def last_words(output: IO[bytes]) -> str:
    """Return the end of a process's output, at most `LAST_WORDS` characters."""
    output.seek(0)
    return output.read().decode(errors="replace").strip()[-LAST_WORDS:]


def die_with_parent() -> None:
    """Let the system kill this process when the thread that started it ends; Linux only."""
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)


def occupy_standard_descriptors() -> None:
    """Open the null device for each of standard input, output and error that is closed.

    Otherwise a file that is opened later gets the number 0, 1 or 2. A child process uses this
    number for its own standard input, output or error, and cannot inherit the file.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # The system assigns the lowest free number, which is `number`.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)


# Runs in a new interpreter, not as `preexec_fn`: if this process has threads, Python code that runs
# between fork and exec may hang.
_WRAPPER = """
import ctypes, os, resource, signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
ctypes.CDLL(None).prctl(int(sys.argv[1]), int(sys.argv[2]), 0, 0, 0)
if int(sys.argv[4]):
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    most = int(sys.argv[4]) if hard == resource.RLIM_INFINITY else min(int(sys.argv[4]), hard)
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))
for number in range(3):
    try:
        os.fstat(number)
    except OSError:
        os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
if os.getppid() == int(sys.argv[3]):
    os.execv(sys.argv[5], sys.argv[5:])
"""


def dying_with_parent(command: Sequence[str], most_bytes: int = 0) -> list[str]:
    """Return a command that runs `command`, a path with arguments, and ends with this process.

    On other systems than Linux, return `command`. `most_bytes`: memory that the command and its
    children may each allocate; 0: any.
    """
    if sys.platform != "linux":
        return list(command)
    numbers = (_PR_SET_PDEATHSIG, int(signal.SIGKILL), os.getpid(), most_bytes)
    return [sys.executable, "-I", "-S", "-c", _WRAPPER, *map(str, numbers), *command]


def start_dying_with_process(command: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
    """Start a command that ends with this process, not with the calling thread; Linux only.

    The system ends a command when the thread that started it ends. Commands are therefore started
    by the main thread, or by a thread that lasts as long as this process.
    """

    def start() -> subprocess.Popen[Any]:
        return subprocess.Popen(dying_with_parent(command), **options)

    if threading.current_thread() is threading.main_thread():
        return start()
    return _staying_thread(os.getpid()).submit(start).result()


def start_python(
    words: Sequence[str], env: Mapping[str, str] | None = None, **options: Any
) -> subprocess.Popen[Any]:
    """Start a Python that ends with this process and finds the same modules.

    It finds modules in the working directory only if this process does.

    `words`: `-m` and a module, `-c` and a program, or a file; then arguments. `env`: environment
    variables in addition to those of this process.
    """
    here = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join([here, *(place for place in sys.path if place)])
    return start_dying_with_process(
        [sys.executable, "-P", *words],
        env={**os.environ, **(env or {}), "PYTHONPATH": path},
        **options,
    )


@cache
def _staying_thread(_: int) -> ThreadPoolExecutor:
    """Return the thread that starts processes; a fork of this process needs a thread of its own."""
    return ThreadPoolExecutor(1, "starts-processes")
