"""`Pool`: worker processes that do one job together, order by order, and survive their deaths.

Every worker keeps its state in its own memory, and leaves an image of it behind with every order
that changes it. There are two images of each: the one that is committed, and the one that is being
written. When all workers have carried out an order, the pool commits it. A worker that dies before
that is replaced: its successor reads the committed image and carries the order out again. It reads
the same, so it does the same.
"""

from __future__ import annotations

import json
import os
import select
import signal
import time
import weakref
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from math import isnan, nan
from typing import Any, NamedTuple

import numpy as np

from cavmarl.errors import WorkerDeathError, WorkerError, WorkerFailureError, WorkerStartError
from cavmarl.runtime.barrier import NUMBER, WORDS, Meeting, usable_cores
from cavmarl.runtime.fork_server import ForkServer, Process, ServerGoneError
from cavmarl.runtime.shared_memory import Segment
from cavmarl.runtime.watchdog import CHECK_S, Watchdog, processor_s
from cavmarl.runtime.worker import (
    ANSWER,
    FAILED,
    LOADS,
    MAIL,
    MAX_MESSAGE,
    NOTHING,
    OUT_OF_MEMORY,
    SILENT,
    TASK,
)

__all__ = ["Death", "Pool", "Program"]

_LINE_BYTES = WORDS * 8
_FIRST_IMAGE_BYTES = 1 << 12


class Program(NamedTuple):
    """What the workers of a pool run.

    Attributes:
        module: that is run as a program and calls `worker.serve`.
        recipe: from which it makes the jobs, as JSON knows it.
        parts: what each worker hosts, in words.
        segments: that the jobs share with the pool; the recipe names their descriptors.
        tasks: what each task is called, by its number.
    """

    module: str
    recipe: Mapping[str, Any]
    parts: tuple[str, ...]
    segments: tuple[Segment, ...]
    tasks: tuple[str, ...]


@dataclass
class Death:
    """What became of one process and of what it did; times are those of `time.monotonic`.

    Attributes:
        worker: whose process it was.
        order: that was to be carried out.
        cause: signal or exit status, or why it was taken for dead.
        ordered_s: when the order was given.
        noticed_s: when that was noticed.
        replaced_s: when its successor had its order.
        done_s: when that was carried out; nan: not yet.
    """

    worker: int
    order: int
    cause: str
    ordered_s: float
    noticed_s: float
    replaced_s: float
    done_s: float = nan


class Pool:
    """m worker processes.

    Args:
        program: what they run.
        timeout_s: for so long a worker may be busy with one order.
        repeats: how often an order is begun again because a worker has died.

    Attributes:
        deaths: all that there were.

    Raises:
        WorkerStartError: no process, or no memory.
        WorkerFailureError: an exception while the jobs were made.
    """

    def __init__(self, program: Program, timeout_s: float, repeats: int) -> None:
        if not hasattr(os, "pidfd_open"):
            raise WorkerStartError("workers need Linux 5.3 or later: use workers=0")
        self.deaths: list[Death] = []
        self._program = program
        self._timeout_s = timeout_s
        self._repeats = repeats
        self._count = len(program.parts)
        self._all = tuple(range(self._count))
        self._truth = -1  # the slot of the committed images
        self._open: tuple[int, ...] = ()  # workers with an order that nobody has waited for
        self._stale = [False] * self._count  # whose memory is not what is committed
        self._poll = select.poll()
        self._checked_s = 0.0
        self._ordered_s = 0.0
        held = _Held(list(program.segments))
        self._held = held
        self._finalizer = weakref.finalize(self, held.release)
        try:
            self._make_memory()
            self._start()
        except BaseException:
            self.close()
            raise

    @property
    def pids(self) -> list[int]:
        """Of the workers' processes."""
        return [process.pid for process in self._held.processes.values()]

    @property
    def server_pid(self) -> int:
        """Of the process that forks them."""
        server = self._held.server
        return 0 if server is None else server.pid

    def processor_s(self) -> list[float]:
        """Processor time that each worker's process has taken."""
        return [processor_s(pid) for pid in self.pids]

    def run(self, task: int, letter: Any = None, commits: bool = True) -> list[Any]:
        """Let all workers do a task.

        Args:
            task: of the job.
            letter: what is said to all, as JSON knows it.
            commits: the task changes their state.

        Returns:
            what each has answered.

        Raises:
            WorkerDeathError: too many processes died of it; the pool is closed.
            WorkerFailureError: an exception in a worker; all are as they were before.
        """
        return self._command(self._all, task, letter, commits)

    def ask(self, worker: int, task: int, letter: Any = None) -> Any:
        """Let one worker do a task that changes nothing; raises as `run`."""
        return self._command((worker,), task, letter, False)[0]

    def ping(self) -> None:
        """Let all workers do nothing: an empty barrier."""
        self.run(NOTHING, commits=False)

    def close(self) -> None:
        """End all processes and give the memory back; what is mapped stays readable."""
        self._finalizer()

    def _make_memory(self) -> None:
        held = self._held
        orders = held.hold(Segment.make(self._count * _LINE_BYTES))
        statuses = [held.hold(Segment.make(_LINE_BYTES)) for _ in range(self._count)]
        images = [
            [held.hold(Segment.make(_FIRST_IMAGE_BYTES)) for _ in range(2)]
            for _ in range(self._count)
        ]
        text = json.dumps(self._program.recipe).encode()
        recipe = held.hold(Segment.make(len(text)))
        os.pwrite(recipe.fd, text, 0)
        self._orders = np.frombuffer(orders.map(), dtype=np.int64).reshape(-1, WORDS)
        self._statuses = [np.frombuffer(s.map(), dtype=np.int64)[:WORDS] for s in statuses]
        self._crowded = self._count + 1 > usable_cores()
        self._told = {
            "recipe": recipe.fd,
            "recipe_bytes": len(text),
            "orders": orders.fd,
            "statuses": [segment.fd for segment in statuses],
            "images": [[image.fd for image in pair] for pair in images],
            "crowded": self._crowded,
        }

    def _start(self) -> None:
        """Start the process that forks, and a process for every worker."""
        fds = tuple(segment.fd for segment in self._held.segments)
        self._held.server = ForkServer(self._program.module, self._told, fds)
        self._meetings: dict[int, Meeting] = {}
        for k in range(self._count):
            self._fork(k)

    def _fork(self, k: int) -> None:
        assert self._held.server is not None
        process = self._held.server.fork(k)
        self._held.processes[k] = process
        self._poll.register(process.pidfd, select.POLLIN)
        self._poll.register(process.wire, select.POLLIN)
        self._meetings[k] = Meeting(self._orders[k], self._statuses[k], process.wire, self._crowded)

    def _command(
        self, workers: tuple[int, ...], task: int, letter: Any, commits: bool
    ) -> list[Any]:
        if not self._finalizer.alive:
            raise WorkerError("the workers are closed: make the environment anew")
        if self._open:
            self._settle()
        mail = None if letter is None else MAIL + json.dumps(letter).encode()
        if mail is not None and len(mail) > MAX_MESSAGE:
            raise WorkerError(f"a letter of {len(mail)} bytes: at most {MAX_MESSAGE} can be sent")
        slot = 1 - max(self._truth, 0) if commits else -1
        self._open = workers
        self._ordered_s = time.monotonic()
        head = (task, mail is not None, slot, self._truth)
        for k in workers:
            words = self._orders[k]
            words[TASK : LOADS + 1] = (*head, self._stale[k])
            self._post(k, words.item(NUMBER) + 1, mail)
        self._await(workers, mail)
        answers, failures = self._read(workers)
        self._open = ()
        if failures:
            for k in workers:
                self._stale[k] = True
            raise failures[0]
        for k in workers:
            self._stale[k] = False
        if commits:
            self._truth = slot
        return answers

    def _post(self, k: int, number: int, mail: bytes | None) -> None:
        """Give a worker its order; that it is dead is noticed later."""
        self._send(k, mail)
        self._meetings[k].post(number)

    def _send(self, k: int, mail: bytes | None) -> None:
        if mail is not None:
            with suppress(BrokenPipeError, ConnectionResetError):
                self._held.processes[k].wire.send(mail)

    def _settle(self) -> None:
        """Wait for the workers of an order whose caller was interrupted; it is not committed."""
        for k in self._open:
            process = self._held.processes[k]
            number = int(self._orders[k, NUMBER])
            watchdog = Watchdog(process.pid, self._timeout_s)
            while not self._meetings[k].has(number):
                if select.select([process.pidfd], [], [], CHECK_S)[0]:
                    self._statuses[k][NUMBER] = number  # nobody else writes there any more
                elif watchdog.verdict() is not None:
                    process.kill()
            process.collect()
            process.mail.clear()
            self._stale[k] = True
        self._open = ()

    def _await(self, workers: tuple[int, ...], mail: bytes | None) -> None:
        """Return when all workers have carried out their order.

        Raises:
            WorkerDeathError: too many processes died of it; the pool is closed.
        """
        began = time.perf_counter()
        pending = [k for k in workers if not self._meetings[k].watch(self._orders.item(k, NUMBER))]
        if pending:
            self._await_asleep(pending, mail)
        lasted_s = time.perf_counter() - began
        for k in workers:
            self._meetings[k].lasted(lasted_s)

    def _await_asleep(self, pending: list[int], mail: bytes | None) -> None:
        first = len(self.deaths)
        causes: dict[int, list[str]] = {k: [] for k in pending}
        watchdogs: dict[int, Watchdog] = {}
        while True:
            dead = self._sleep(pending)
            pending = [k for k in pending if not self._has(k)]
            for death in self.deaths[first:]:
                if death.worker not in pending and isnan(death.done_s):
                    death.done_s = time.monotonic()
            if not pending:
                return
            for k, cause in (dead or self._hanging(pending, watchdogs)).items():
                cause = self._replace(k, cause, mail)
                watchdogs.pop(k, None)
                if k in pending:
                    causes[k].append(cause)
                    if len(causes[k]) > self._repeats:
                        self._give_up(k, causes[k])

    def _sleep(self, pending: list[int]) -> dict[int, str]:
        """Sleep until a worker is done, or dead, or for `CHECK_S`; who is dead."""
        ready: set[int] = set()
        lying = [self._meetings[k].lie_down(self._orders.item(k, NUMBER)) for k in pending]
        if all(lying):
            ready = {fd for fd, _ in self._poll.poll(1000.0 * CHECK_S)}
        for k in pending:
            self._meetings[k].get_up()
        if not ready:
            return {}
        processes = self._held.processes
        for process in processes.values():
            if process.wire.fileno() in ready:
                process.collect()
        return {k: "" for k, process in processes.items() if process.pidfd in ready}

    def _hanging(self, pending: list[int], watchdogs: dict[int, Watchdog]) -> dict[int, str]:
        """Who of those that should be working is not, and why one thinks so."""
        now = time.monotonic()
        if now - self._checked_s < CHECK_S:
            return {}
        self._checked_s = now
        found: dict[int, str] = {}
        for k in pending:
            if k not in watchdogs:
                watchdogs[k] = Watchdog(self._held.processes[k].pid, self._timeout_s)
            verdict = watchdogs[k].verdict()
            if verdict is not None:
                found[k] = verdict
        return found

    def _has(self, k: int) -> bool:
        return self._meetings[k].has(self._orders.item(k, NUMBER))

    def _replace(self, k: int, cause: str, mail: bytes | None) -> str:
        """Give a worker a new process, and that one the order, if it is not carried out yet.

        Args:
            k: the worker.
            cause: why its process is taken for dead; empty: it has ended by itself.
            mail: that came with the order.

        Returns:
            what it died of.
        """
        noticed_s = time.monotonic()
        old = self._held.processes[k]
        try:
            old.kill()
            self._poll.unregister(old.pidfd)
            self._poll.unregister(old.wire)
            old.collect()
            try:
                assert self._held.server is not None
                status = self._held.server.bury(old)
                cause = cause or _say(status)
                self._fork(k)
            except ServerGoneError:
                cause = cause or "the process that starts workers ended"
                self._start_anew(k, mail)
            if self._has(k):
                self._held.processes[k].mail = old.mail
            else:
                self._send(k, mail)
            old.release()
        except BaseException:
            self.close()
            raise
        now = time.monotonic()
        order = self._orders.item(k, NUMBER)
        self.deaths.append(Death(k, order, cause, self._ordered_s, noticed_s, now))
        return cause

    def _start_anew(self, k: int, mail: bytes | None) -> None:
        """The process that forks is gone, or hangs: another one, and new workers for all."""
        assert self._held.server is not None
        self._held.server.close()
        others = {j: process for j, process in self._held.processes.items() if j != k}
        for process in others.values():
            process.kill()
            self._poll.unregister(process.pidfd)
            self._poll.unregister(process.wire)
            process.collect()
        self._start()
        for j, process in others.items():
            if self._has(j):
                self._held.processes[j].mail = process.mail
            elif j in self._open:
                self._send(j, mail)
            process.release()

    def _give_up(self, k: int, causes: list[str]) -> None:
        self.close()
        task = self._orders.item(k, TASK)
        what = "nothing" if task == NOTHING else self._program.tasks[task]
        order = self._orders.item(k, NUMBER)
        raise WorkerDeathError(k, self._program.parts[k], order, what, causes)

    def _read(self, workers: tuple[int, ...]) -> tuple[list[Any], list[WorkerFailureError]]:
        """What the workers have answered, and what went wrong in them."""
        answers: list[Any] = []
        failures: list[WorkerFailureError] = []
        for k in workers:
            kind = self._statuses[k].item(ANSWER)
            answer: Any = None
            if kind != SILENT:
                process = self._held.processes[k]
                process.collect()
                answer = json.loads(process.mail.pop(0))
            if kind == FAILED:
                part = self._program.parts[k]
                failures.append(WorkerFailureError(k, part, **answer))
            answers.append(answer)
        return answers, failures


def _say(status: int) -> str:
    """What an exit status means."""
    if status == OUT_OF_MEMORY:
        return "out of memory"
    if status >= 0:
        return f"exit status {status}"
    return signal.Signals(-status).name


class _Held:
    """What has to be given back, whoever forgets to.

    Args:
        segments: of the program.
    """

    def __init__(self, segments: list[Segment]) -> None:
        self.segments = segments
        self.server: ForkServer | None = None
        self.processes: dict[int, Process] = {}
        self._pid = os.getpid()

    def hold(self, segment: Segment) -> Segment:
        """Give it back with the others."""
        self.segments.append(segment)
        return segment

    def release(self) -> None:
        """End the processes; a fork of the pool's process has no right to."""
        if os.getpid() != self._pid:
            return
        for process in self.processes.values():
            process.kill()
        if self.server is not None:
            self.server.close()
        for process in self.processes.values():
            process.release()
        for segment in self.segments:
            segment.close()
        self.processes.clear()
