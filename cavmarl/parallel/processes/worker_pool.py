"""`Pool`: worker processes that carry out commands together, and survive deaths of workers.

Each worker has its state in its own memory, and writes an image of the state after each command
that changes it. A worker has two images: the committed image, and the image that it writes. When
all workers have carried out a command, the pool commits the command. If a worker dies before that,
its successor resumes from the committed image and repeats the command. Commands are deterministic,
so the result is the same.
"""

from __future__ import annotations

import json
import os
import time
import weakref
from dataclasses import dataclass
from math import isnan, nan
from typing import Any

from cavmarl.core.errors import WorkerDeathError, WorkerError, WorkerFailureError
from cavmarl.core.processes import refuse_fork
from cavmarl.parallel.processes.process_barrier import LONG_WORK_S
from cavmarl.parallel.processes.watchdog import CHECK_S, Watchdog, processor_s
from cavmarl.parallel.processes.worker_loop import (
    FAILED,
    MAIL,
    MAX_MESSAGE,
    NOTHING,
    TASK,
    TeamFailedError,
)
from cavmarl.parallel.processes.worker_processes import Program, WorkerProcesses

__all__ = ["Death", "Pool", "Program"]


@dataclass
class Death:
    """The death of a worker process and its replacement; times are of `time.monotonic`."""

    worker: int  # number of the worker
    order: int  # number of the command in progress
    cause: str  # signal, exit status, or why the process counts as dead
    ordered_s: float  # when the command was sent
    noticed_s: float  # when the death was noticed
    replaced_s: float  # when the successor had received the command
    done_s: float = nan  # when the successor had carried out the command; nan: not yet


class Pool:
    """m worker processes.

    Raises:
        WorkerError: a process cannot be started, or there is not enough memory.
        WorkerFailureError: an exception was raised while the jobs were made.
    """

    def __init__(
        self,
        program: Program,
        timeout_s: float,  # limit on the duration of a command
        repeats: int,  # how often a start or a command is repeated after deaths
        may_sleep: bool = False,  # whether workers may wait for other programs
    ) -> None:
        self._may_sleep = may_sleep
        self.deaths: list[Death] = []  # all deaths since the start
        self._program = program
        self._timeout_s = timeout_s
        self._repeats = repeats
        self._all = tuple(range(len(program.parts)))
        self._committed = -1  # the slot of the committed images
        self._open: tuple[int, ...] = ()  # workers with a command that is not committed
        self._stale = [False] * len(program.parts)  # workers whose memory differs from their image
        self._ordered_s = 0.0
        self._lasted: dict[int, float] = {}  # last duration of each task in s
        self._pid = os.getpid()
        self._processes = WorkerProcesses(program, repeats)
        self._finalizer = weakref.finalize(self, self._processes.release)

    @property
    def pids(self) -> list[int]:
        return [process.pid for process in self._processes.processes.values()]

    @property
    def server_pid(self) -> int:
        return self._processes.server_pid

    def team_of(self, worker: int) -> tuple[int, ...]:
        """Return the workers that are replaced together with a worker, including itself."""
        return self._program.team_of(worker)

    def processor_s(self) -> list[float]:
        return [processor_s(pid) for pid in self.pids]

    def run(self, task: int, payload: Any = None, commits: bool = True) -> list[Any]:
        """Run a task on all workers.

        Returns:
            the answer of each worker.

        Raises:
            WorkerDeathError: too many processes died during the task; the pool is closed.
            WorkerFailureError: a worker raised an exception; the state is as before the task.
        """
        return self._command(self._all, task, payload, commits)

    def ask(self, worker: int, task: int, payload: Any = None) -> Any:
        """Run a task that changes nothing on one worker. Raises the errors of `run`."""
        return self._command((worker,), task, payload, False)[0]

    def ping(self) -> None:
        """Let all workers do nothing, and wait for them."""
        self.run(NOTHING, commits=False)

    def rename(self, parts: tuple[str, ...]) -> None:
        self._program = self._program._replace(parts=parts)

    def close(self) -> None:
        """End all processes and release the memory; mapped arrays stay readable."""
        self._finalizer()

    def _command(
        self, workers: tuple[int, ...], task: int, payload: Any, commits: bool
    ) -> list[Any]:
        if not self._finalizer.alive:
            raise WorkerError("the workers are closed: make a new environment")
        refuse_fork(self._pid, "the workers")
        if self._open:
            self._settle()
        mail = None if payload is None else MAIL + json.dumps(payload).encode()
        if mail is not None and len(mail) > MAX_MESSAGE:
            raise WorkerError(f"a payload of {len(mail)} bytes: at most {MAX_MESSAGE} can be sent")
        slot = 1 - max(self._committed, 0) if commits else -1
        self._open = workers
        self._ordered_s = time.monotonic()
        head = (task, mail is not None, slot, self._committed)
        expected_s = self._lasted.get(task, 0.0)
        sleeps = expected_s > LONG_WORK_S
        if workers == self._all:
            self._processes.keep_apart()  # uses the cores of the last command
        self._processes.order(workers, head, self._stale, mail, sleeps)
        self._await(workers, mail, expected_s, sleeps)
        self._lasted[task] = time.monotonic() - self._ordered_s
        answers = self._read(workers)
        for k in workers:
            self._stale[k] = False
        if commits:
            self._committed = slot
        self._open = ()
        return answers

    def _settle(self) -> None:
        """Wait for the end of a command that was interrupted or failed; it is not committed."""
        for k in self._open:
            pid = self._processes.processes[k].pid
            watchdog = Watchdog(pid, self._timeout_s, self._may_sleep)
            while not self._processes.settle(k, CHECK_S):
                if watchdog.verdict() is not None or self._processes.is_left_alone(k):
                    self._processes.processes[k].kill()
            self._stale[k] = True
        self._open = ()

    def _await(
        self, workers: tuple[int, ...], mail: bytes | None, expected_s: float, sleeps: bool
    ) -> None:
        pending = list(workers)
        if not sleeps:
            pending = [k for k in workers if not self._processes.watch(k, expected_s)]
        if pending:
            self._await_asleep(pending, mail, sleeps)

    def _await_asleep(self, pending: list[int], mail: bytes | None, is_asleep: bool) -> None:
        dead = self._processes.sleep(pending, CHECK_S, is_asleep)
        first = len(self.deaths)
        guard = _Guard(self._processes, self._timeout_s, self._ordered_s, self._may_sleep)
        while pending or dead:
            asked = pending
            pending = self._pending()
            if pending and len(pending) < len(asked):
                # All workers finish at about the same time, so first poll the other workers.
                self._processes.drain_wakeups()
                pending = [k for k in pending if not self._processes.watch(k, is_soon=True)]
            self._note_done(first, pending)
            if not (pending or dead):
                break
            suspects = dict.fromkeys(dead, "") or guard.hanging(pending)
            suspected = {k: self._processes.processes[k] for k in suspects} | dead
            for k, cause in suspects.items():
                if self._processes.processes[k] is suspected[k]:  # still the hung or dead process
                    self._replace(k, cause, mail)
            pending = self._pending()
            for k in pending:
                team = self.team_of(k)
                causes = [death.cause for death in self.deaths[first:] if death.worker in team]
                if len(causes) > self._repeats:
                    self._give_up(k, causes)
            dead = self._processes.sleep(pending, CHECK_S) if pending else {}
        self._note_done(first, pending)

    def _note_done(self, first: int, pending: list[int]) -> None:
        """Set `done_s` in each entry of `deaths[first:]` whose successor has just finished."""
        for death in self.deaths[first:]:
            if death.worker not in pending and isnan(death.done_s):
                death.done_s = time.monotonic()

    def _pending(self) -> list[int]:
        return [k for k in self._open if not self._processes.has(k)]

    def _replace(self, k: int, cause: str, mail: bytes | None) -> None:
        """Replace the process of a worker, which is dead or hangs."""
        noticed_s = time.monotonic()
        try:
            found = self._processes.replace(k, mail, self._open)
        except BaseException:
            self.close()
            raise
        number = self._processes.number(k)
        now = time.monotonic()
        self.deaths.append(Death(k, number, cause or found, self._ordered_s, noticed_s, now))

    def _give_up(self, k: int, causes: list[str]) -> None:
        self.close()
        task = self._processes.orders.item(k, TASK)
        what = "nothing" if task == NOTHING else self._program.tasks[task]
        part, number = self._program.parts[k], self._processes.number(k)
        raise WorkerDeathError(k, part, number, what, causes)

    def _read(self, workers: tuple[int, ...]) -> list[Any]:
        answers: list[Any] = []
        failure: WorkerFailureError | None = None
        for k in workers:
            kind, answer = self._processes.answer(k)
            if kind == FAILED and (failure is None or failure.kind == TeamFailedError.__name__):
                failure = WorkerFailureError(k, self._program.parts[k], **answer)
            answers.append(answer)
        if failure is not None:
            raise failure
        return answers


class _Guard:
    """Regularly checks the workers for which the pool waits."""

    def __init__(
        self, processes: WorkerProcesses, timeout_s: float, since_s: float, may_sleep: bool
    ) -> None:
        self._processes = processes
        self._timeout_s, self._may_sleep = timeout_s, may_sleep
        self._watchdogs: dict[int, Watchdog] = {}
        self._next_s = since_s + CHECK_S

    def hanging(self, pending: list[int]) -> dict[int, str]:
        """Return the workers that hang, and what is wrong with each."""
        now = time.monotonic()
        if now < self._next_s:
            return {}
        self._next_s = now + CHECK_S
        found: dict[int, str] = {}
        for k in pending:
            pid = self._processes.processes[k].pid
            if pid not in self._watchdogs:
                self._watchdogs[pid] = Watchdog(pid, self._timeout_s, self._may_sleep)
            verdict = self._watchdogs[pid].verdict()
            if verdict is not None:
                found[k] = verdict
        return found
