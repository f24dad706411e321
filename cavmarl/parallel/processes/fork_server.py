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
from cavmarl.core.processes import start_python
from cavmarl.parallel.processes.process_barrier import WAKE
from cavmarl.parallel.processes.watchdog import CHECK_S, STOPPED_CHECKS, is_stopped
from cavmarl.parallel.processes.worker_loop import MAIL, MAX_MESSAGE

ANSWER_MS = 2_000  # to fork or to reap; a server that takes longer is stopped or broken
END_S = 1.0  # for all to end by themselves

# One thread a worker: the processes share the cores out among themselves.
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)


def has_ended(pidfds: Iterable[int], limit_s: float | None) -> bool:
    """Whether one of some processes has ended, after a while at most; None: as long as it takes.

    By `poll`: `select` takes no descriptor above 1,023.
    """
    waiting = select.poll()
    for pidfd in pidfds:
        waiting.register(pidfd, select.POLLIN)
    return bool(waiting.poll(None if limit_s is None else 1000.0 * limit_s))


class ServerGoneError(Exception):
    """The forking process does not answer any more."""


@dataclass
class Process:
    """One worker's process."""

    pid: int  # its number, not given again until it is reaped
    pidfd: int  # readable when it has ended
    wire: socket.socket  # socket to it
    mail: list[bytes] = field(default_factory=list)  # what it has sent, unread

    def collect(self) -> None:
        """Take what has come through the wire; calls to wake up are forgotten."""
        with suppress(BlockingIOError, ConnectionResetError):
            while self.receive():
                pass

    def receive(self) -> bool:
        """Take one message; False: the other end is closed.

        Raises:
            BlockingIOError: none has come.
            ConnectionResetError: the other end was closed before it had read all.
        """
        message = self.wire.recv(MAX_MESSAGE, socket.MSG_DONTWAIT)
        if message and message != WAKE:
            self.mail.append(message[len(MAIL) :])
        return bool(message)

    def kill(self) -> None:
        """See to it that it is dead, whatever it was doing."""
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.pidfd, signal.SIGKILL)
        has_ended([self.pidfd], None)

    def release(self) -> None:
        os.close(self.pidfd)
        self.wire.close()


class ForkServer:
    """Starts the process and asks it for workers.

    Raises:
        ServerGoneError: it was killed or stopped before it was ready.
        WorkerFailureError: an exception in it.
    """

    def __init__(
        self,
        program: str,  # module that is run, and calls `worker_loop.serve`
        start: Mapping[str, Any],  # JSON message that it gets; it names descriptors by number
        descriptors: tuple[int, ...],  # that it and its workers get
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
        """A new process for a worker. Raises WorkerError: this process has no descriptors left."""
        ours, theirs = _wires()
        try:
            pid = int(self._ask({"fork": number}, theirs.fileno())["pid"])
            return Process(pid, os.pidfd_open(pid), ours)
        except (ServerGoneError, ProcessLookupError) as error:
            ours.close()
            raise ServerGoneError from error
        except OSError as error:
            ours.close()
            raise WorkerError(f"no descriptor of a worker's process: {error}") from error
        finally:
            theirs.close()

    def reap(self, process: Process) -> int:
        """Let a process that is dead be forgotten.

        Returns:
            its exit status; of one that was killed, minus the signal.

        Raises:
            ServerGoneError: the server does not answer.
        """
        return int(self._ask({"reap": process.pid})["status"])

    def close(self) -> None:
        self._wire.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()  # the system kills the workers
            self._process.wait()

    def _await_ready(self) -> None:
        """Wait until it is ready; that takes as long as its work, unless it is stopped."""
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
                f"the process that starts workers ended with {status} before it was ready; what it "
                "printed stands on standard error"
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
    """The two ends of a wire that carries messages."""
    try:
        return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    except OSError as error:
        raise WorkerError(f"no socket: {error}") from error
