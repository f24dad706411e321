"""`ForkServer`: the pool's handle of the process that forks its workers."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from cavmarl.core.errors import WorkerError, WorkerFailureError
from cavmarl.core.processes import end_process, occupy_standard_descriptors, start_python
from cavmarl.parallel.processes.process_barrier import WAKE
from cavmarl.parallel.processes.watchdog import CHECK_S, STOPPED_CHECKS, is_stopped
from cavmarl.parallel.processes.worker_loop import MAIL, MAX_MESSAGE

ANSWER_MS = 2_000  # time to fork or reap; a server that takes longer counts as stopped or broken
END_S = 1.0  # time for the server and its workers to end

# One thread per worker: the processes themselves share the cores.
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)


def has_ended(pidfds: Iterable[int], limit_s: float | None) -> bool:
    """Wait until one of the processes has ended; return False after the limit (None: no limit).

    The function uses `poll`, since `select` accepts no descriptor above 1,023.
    """
    waiting = select.poll()
    for pidfd in pidfds:
        waiting.register(pidfd, select.POLLIN)
    return bool(waiting.poll(None if limit_s is None else 1000.0 * limit_s))


class ServerGoneError(Exception):
    """The fork server does not answer."""


@dataclass
class Process:
    """The process of a worker."""

    pid: int  # not reused until the process is reaped
    pidfd: int  # readable when the process has ended
    wire: socket.socket  # connection to the process
    mail: list[bytes] = field(default_factory=list)  # received messages that are still unread

    def collect(self) -> None:
        """Receive all messages that have arrived, and drop messages that are only wake-ups."""
        with suppress(BlockingIOError, ConnectionResetError):
            while self.receive():
                pass

    def receive(self) -> bool:
        """Receive one message; return False if the other end is closed.

        Raises:
            BlockingIOError: no message has arrived.
            ConnectionResetError: the other end was closed before it had read all messages.
        """
        message = self.wire.recv(MAX_MESSAGE, socket.MSG_DONTWAIT)
        if message and message != WAKE:
            self.mail.append(message[len(MAIL) :])
        return bool(message)

    def kill(self) -> None:
        """Kill the process, and wait for its end."""
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.pidfd, signal.SIGKILL)
        has_ended([self.pidfd], None)

    def release(self) -> None:
        os.close(self.pidfd)
        self.wire.close()


class ForkServer:
    """Starts the server process, and lets it fork workers.

    Raises:
        ServerGoneError: the server was killed or stopped before it was ready.
        WorkerError: the server cannot be started, or has ended before it was ready.
        WorkerFailureError: the server has raised an exception.
    """

    def __init__(
        self,
        program: str,  # module that the server runs; it has to call `worker_loop.serve`
        start: Mapping[str, Any],  # JSON message for the server, with numbers of descriptors
        descriptors: tuple[int, ...],  # inherited by the server and its workers
    ) -> None:
        ours, theirs = _wires()
        start_message = {
            **start,
            "pool": theirs.fileno(),
            "parent": os.getpid(),
        }
        self._wire = ours
        try:
            self._process = start_python(
                ["-m", program, json.dumps(start_message)],
                stdin=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(), *descriptors),
                env=_ONE_THREAD,
            )
        except OSError as error:
            ours.close()
            raise WorkerError(f"{sys.executable}: {error}") from error
        finally:
            theirs.close()
        try:
            self._await_ready()
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        return self._process.pid

    def fork(self, number: int) -> Process:
        """Fork a worker.

        Raises:
            ServerGoneError: the server does not answer.
            WorkerError: this process has no descriptors left.
        """
        ours, theirs = _wires()
        try:
            pid = int(self._ask({"fork": number}, theirs.fileno())["pid"])
            return Process(pid, os.pidfd_open(pid), ours)
        except (ServerGoneError, ProcessLookupError) as error:
            ours.close()
            raise ServerGoneError from error
        except OSError as error:
            ours.close()
            raise WorkerError(f"no descriptor for the process of a worker: {error}") from error
        finally:
            theirs.close()

    def reap(self, process: Process) -> int:
        """Reap a dead process.

        Returns:
            its exit status, or minus the signal that killed it.

        Raises:
            ServerGoneError: the server does not answer.
        """
        return int(self._ask({"reap": process.pid})["status"])

    def close(self) -> None:
        self._wire.close()
        end_process(self._process, END_S)  # the system kills the workers

    def _await_ready(self) -> None:
        """Wait until the server is ready, without a limit, unless it is stopped."""
        poll = select.poll()
        poll.register(self._wire, select.POLLIN)
        stopped = 0
        while not poll.poll(1000.0 * CHECK_S):
            stopped = stopped + 1 if is_stopped(self._process.pid) else 0
            if stopped == STOPPED_CHECKS:
                raise ServerGoneError("stopped (SIGSTOP)")
        message = self._wire.recv(MAX_MESSAGE)
        if not message:
            status = self._process.wait()
            if status < 0:
                raise ServerGoneError(signal.Signals(-status).name)
            raise WorkerError(
                f"the process that starts workers ended with exit status {status} before it was "
                "ready; see its standard error"
            )
        answer = json.loads(message)
        if "ready" not in answer:
            raise WorkerFailureError(
                -1, "the process that starts them", answer["kind"], answer["text"],
                answer["traceback"],
            )  # fmt: skip

    def _ask(self, question: Mapping[str, Any], descriptor: int | None = None) -> dict[str, Any]:
        descriptors = [] if descriptor is None else [descriptor]
        try:
            socket.send_fds(self._wire, [json.dumps(question).encode()], descriptors)
            poll = select.poll()
            poll.register(self._wire, select.POLLIN)
            message = self._wire.recv(MAX_MESSAGE) if poll.poll(ANSWER_MS) else b""
        except OSError as error:
            raise ServerGoneError from error
        if not message:
            raise ServerGoneError
        answer: dict[str, Any] = json.loads(message)
        return answer


def _wires() -> tuple[socket.socket, socket.socket]:
    """Return the two ends of a connection that carries messages."""
    occupy_standard_descriptors()
    try:
        return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    except OSError as error:
        raise WorkerError(f"no socket: {error}") from error
