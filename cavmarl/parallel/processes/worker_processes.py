"""`WorkerProcesses` starts and replaces the processes of a pool, and sends commands to them."""

from __future__ import annotations

import json
import os
import select
import signal
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from cavmarl.core.errors import WorkerError
from cavmarl.parallel.memory.shared_memory import Segment
from cavmarl.parallel.processes.core_placement import keep_apart
from cavmarl.parallel.processes.fork_server import (
    ForkServer,
    Process,
    ServerGoneError,
    has_ended,
)
from cavmarl.parallel.processes.process_barrier import (
    NUMBER,
    WORDS,
    WakeSignal,
    present_core,
    usable_cores,
)
from cavmarl.parallel.processes.worker_loop import ANSWER, CORE, LOADS, OUT_OF_MEMORY, SILENT, TASK

_LINE_BYTES = WORDS * 8
_FIRST_IMAGE_BYTES = 1 << 12


class Program(NamedTuple):
    """The program of the workers of a pool."""

    module: str  # module that runs as the program; it has to call `worker_loop.serve`
    message: Mapping[str, Any]  # JSON value from which the program makes the jobs
    parts: tuple[str, ...]  # description of the part of each worker
    # memory shared by the jobs and the pool, which the pool closes; `message` names descriptors
    segments: tuple[Segment, ...]
    tasks: tuple[str, ...]  # name of each task, by its number
    pins: bool = False  # whether to pin each worker to a core of its own, if there are enough cores
    # groups of workers that share their state and cannot continue without each other; a worker
    # that is in no group has a state of its own
    teams: tuple[tuple[int, ...], ...] = ()

    def team_of(self, worker: int) -> tuple[int, ...]:
        """Return the workers that share their state with a worker, including itself."""
        return next((team for team in self.teams if worker in team), (worker,))


class WorkerProcesses:
    """m worker processes and the server that forks them.

    Attributes:
        orders: (m, WORDS) the lines of the pool, one for each worker.

    Raises:
        WorkerError: the server cannot be started, or was killed too often.
        WorkerFailureError: an exception was raised while the jobs were made.
    """

    def __init__(
        self,
        program: Program,
        repeats: int,  # how often the start is repeated after the server was killed
    ) -> None:
        self._program = program
        self._repeats = repeats
        self._count = len(program.parts)
        self._crowded = self._count + 1 > len(usable_cores())
        self._poll = select.poll()
        self._resources = _OwnedResources(list(program.segments))
        self._signals: dict[int, WakeSignal] = {}
        # descriptor → worker, and whether it reports the death of the worker
        self._owners: dict[int, tuple[int, bool]] = {}
        self._woken_by: set[int] = set()  # workers whose unread messages have woken this side
        try:
            if not hasattr(os, "pidfd_open"):
                raise WorkerError("workers need Linux 5.3 or later: use backend='local'")
            self._make_memory()
            self._start()
        except BaseException:
            self._resources.release()
            raise

    @property
    def release(self) -> Callable[[], None]:
        """A function that ends the processes and frees all resources."""
        return self._resources.release

    @property
    def processes(self) -> dict[int, Process]:
        """The process of each worker; empty after `release`."""
        return self._resources.processes

    @property
    def server_pid(self) -> int:
        server = self._resources.server
        return 0 if server is None else server.pid

    def order(
        self,
        workers: Sequence[int],
        head: tuple[int, ...],  # words of the command, from TASK to COMMITTED
        stale: Sequence[bool],  # for each worker, whether its memory differs from its image
        mail: bytes | None,  # payload
        # whether this side sleeps at once, so that its core is free for a worker
        sleeps: bool = False,
    ) -> None:
        """Send the next command; `sleep` detects dead workers.

        Polling workers receive the command before sleeping workers are woken. A worker that may
        need the core of this process is woken last.
        """
        if sleeps:
            for k in workers:
                self._signals[k].announce_sleep()
        asleep = []
        for k in workers:
            words = self.orders[k]
            words[TASK : LOADS + 1] = (*head, stale[k])
            if mail is not None:
                self._send(k, mail)
            if self._signals[k].announce(words.item(NUMBER) + 1):
                asleep.append(k)
        if len(asleep) > 1:
            here = present_core()
            asleep.sort(key=lambda k: self._statuses[k].item(CORE) == here)
        for k in asleep:
            self._signals[k].wake_peer()

    def number(self, k: int) -> int:
        return self.orders.item(k, NUMBER)

    def has(self, k: int) -> bool:
        """Return whether a worker has finished its command."""
        return self._signals[k].has(self.number(k))

    def watch(self, k: int, last_s: float = 0.0, is_soon: bool = False) -> bool:
        """Poll briefly whether a worker finishes its command; longer if `is_soon`."""
        return self._signals[k].watch(self.number(k), last_s, is_soon=is_soon)

    def sleep(
        self, pending: Sequence[int], limit_s: float, is_asleep: bool = False
    ) -> dict[int, Process]:  # dead processes by worker
        """Sleep until a worker has finished or died, or until the limit."""
        ready: list[tuple[int, int]] = []
        if self._none_has_finished(pending) if is_asleep else self._fall_asleep(pending):
            ready = self._poll.poll(1000.0 * limit_s)
        for k in pending:
            self._signals[k].wake()
        if not ready:
            return {}
        found = [self._owners[fd] for fd, _ in ready]
        self._woken_by.update(k for k, is_dead in found if not is_dead)
        return {k: self.processes[k] for k, is_dead in found if is_dead}

    def _fall_asleep(self, pending: Sequence[int]) -> bool:
        """Mark this side as asleep; return False if a worker has finished in the meantime."""
        self.drain_wakeups()
        # A worker that finished while this side was awake has not woken it, so check each number.
        return all(self._signals[k].sleep(self.number(k)) for k in pending)

    def drain_wakeups(self) -> None:
        """Drain the sockets, so that old messages do not wake this side again.

        Each call reads one message per socket; usually, there are no more messages.
        """
        for k in self._woken_by:
            with suppress(BlockingIOError, ConnectionResetError):
                self.processes[k].receive()
        self._woken_by.clear()

    def _none_has_finished(self, pending: Sequence[int]) -> bool:
        """Drain late wake-ups; return False if a worker has finished.

        Call this after the workers received their command. If it drains a wake-up that belongs to
        this command, the number of that worker is already set.
        """
        for fd, _ in self._poll.poll(0):
            k, is_dead = self._owners[fd]
            if not is_dead:
                self._woken_by.add(k)
        self.drain_wakeups()
        return not any(map(self.has, pending))

    def settle(self, k: int, limit_s: float) -> bool:
        """Wait up to a limit for a worker to finish or to die; return whether it did."""
        process = self.processes[k]
        if has_ended([process.pidfd], 0.0 if self.has(k) else limit_s):
            self._statuses[k][NUMBER] = self.number(k)  # the worker is dead
        process.collect()
        process.mail.clear()
        return self.has(k)

    def is_left_alone(self, k: int) -> bool:
        """Return whether another worker of the same team is dead."""
        others = [self.processes[j].pidfd for j in self._program.team_of(k) if j != k]
        return has_ended(others, 0.0)

    def keep_apart(self) -> None:
        """Separate workers that shared a core, unless workers are pinned."""
        cores = [status.item(CORE) for status in self._statuses]
        if len(set(cores)) < len(cores) and not self._program.pins:
            keep_apart([process.pid for process in self.processes.values()], cores)

    def answer(self, k: int) -> tuple[int, Any]:
        """Return how the command of a worker ended, read from its line, and its answer."""
        kind = self._statuses[k].item(ANSWER)
        if kind == SILENT:
            return kind, None
        process = self.processes[k]
        process.collect()
        return kind, json.loads(process.mail.pop(0))

    def replace(self, k: int, mail: bytes | None, ordered: Collection[int]) -> str:
        """Replace the processes of the team of a worker, and repeat an unfinished command.

        Returns:
            the cause of death of the old process.
        """
        team = self._program.team_of(k)
        old = {j: self.processes[j] for j in team}
        for process in old.values():
            self._dismiss(process)
        self._reopen_command(team, ordered)
        server = self._resources.server
        assert server is not None
        try:
            statuses = {j: server.reap(process) for j, process in old.items()}
            cause = _describe_status(statuses[k])
            for j in team:
                self.fork(j)
        except ServerGoneError:
            cause = "the process that starts workers ended"
            old = self._start_anew(old, ordered)
        for j, process in old.items():
            self._hand_over(j, process, mail)
        return cause

    def _dismiss(self, process: Process) -> None:
        process.kill()
        for fd in (process.pidfd, process.wire.fileno()):
            self._poll.unregister(fd)
            del self._owners[fd]
        process.collect()

    def _reopen_command(self, team: tuple[int, ...], ordered: Collection[int]) -> None:
        """Let a dead team repeat a command that not all of its workers have carried out."""
        asked = [j for j in team if j in ordered]
        if not all(self.has(j) for j in asked):
            for j in asked:
                self._statuses[j][NUMBER] = self.number(j) - 1  # the worker is dead

    def _hand_over(self, k: int, old: Process, mail: bytes | None) -> None:
        """Give a new process the unread messages of the old process, or else the payload again."""
        if self.has(k):
            self.processes[k].mail = old.mail
        else:
            self._send(k, mail)
        old.release()

    def _start_anew(self, dead: dict[int, Process], ordered: Collection[int]) -> dict[int, Process]:
        """Restart the fork server, which is gone or hangs, and all workers.

        Returns:
            the old processes of all workers.
        """
        assert self._resources.server is not None
        self._resources.server.close()
        for k, process in self.processes.items():
            if process is dead.get(k):
                continue
            self._dismiss(process)
            if k in dead:  # also release the successor of a dead process
                process.release()
        old = {**self.processes, **dead}
        for team in {self._program.team_of(k) for k in old}:
            self._reopen_command(team, ordered)
        try:
            self._start()
        except BaseException:
            for k, process in old.items():
                if self.processes.get(k) is not process:
                    process.release()
            raise
        return old

    def _send(self, k: int, mail: bytes | None) -> None:
        if mail is not None:
            with suppress(BrokenPipeError, ConnectionResetError):
                self.processes[k].wire.send(mail)

    def _make_memory(self) -> None:
        resources = self._resources
        orders = resources.own(Segment.make(self._count * _LINE_BYTES))
        statuses = [resources.own(Segment.make(_LINE_BYTES)) for _ in range(self._count)]
        images = [
            [resources.own(Segment.make(_FIRST_IMAGE_BYTES)) for _ in range(2)]
            for _ in range(self._count)
        ]
        text = json.dumps(self._program.message).encode()
        message = resources.own(Segment.make(len(text)))
        os.pwrite(message.fd, text, 0)
        self.orders = np.frombuffer(orders.map(), dtype=np.int64).reshape(-1, WORDS)
        self._statuses = [np.frombuffer(s.map(), dtype=np.int64)[:WORDS] for s in statuses]
        self._start_message = {
            "message": message.fd,
            "message_bytes": len(text),
            "orders": orders.fd,
            "statuses": [segment.fd for segment in statuses],
            "images": [[image.fd for image in pair] for pair in images],
            "crowded": self._crowded,
            "cores": sorted(os.sched_getaffinity(0)) if self._program.pins else [],
        }

    def _start(self) -> None:
        """Start the fork server and a process for each worker."""
        fds = tuple(segment.fd for segment in self._resources.segments)
        causes: list[str] = []
        while len(causes) <= self._repeats:
            try:
                self._resources.server = ForkServer(self._program.module, self._start_message, fds)
                for k in range(self._count):
                    self.fork(k)
                return
            except ServerGoneError as error:
                causes.append(str(error) or "no answer")
                self._clear()
        raise WorkerError(
            f"the process that starts workers ended {len(causes)} times before all had started: "
            f"{', '.join(causes)}"
        )

    def _clear(self) -> None:
        """Free the resources of a failed start."""
        for process in self.processes.values():
            if process.wire.fileno() in self._owners:
                self._dismiss(process)
                process.release()
        self.processes.clear()
        if self._resources.server is not None:
            self._resources.server.close()
            self._resources.server = None

    def fork(self, k: int) -> None:
        """Let the server fork the process of worker `k`."""
        assert self._resources.server is not None
        process = self._resources.server.fork(k)
        self.processes[k] = process
        for fd, is_dead in ((process.pidfd, True), (process.wire.fileno(), False)):
            self._poll.register(fd, select.POLLIN)
            self._owners[fd] = k, is_dead
        self._signals[k] = WakeSignal(
            self.orders[k], self._statuses[k], process.wire, self._crowded
        )


def _describe_status(status: int) -> str:
    if status == OUT_OF_MEMORY:
        return "out of memory"
    if status >= 0:
        return f"exit status {status}"
    return signal.Signals(-status).name


class _OwnedResources:
    """Processes and memory of a pool, which are released in any case."""

    def __init__(self, segments: list[Segment]) -> None:
        self.segments = segments
        self.server: ForkServer | None = None
        self.processes: dict[int, Process] = {}
        self._pid = os.getpid()

    def own(self, segment: Segment) -> Segment:
        self.segments.append(segment)
        return segment

    def release(self) -> None:
        """End the processes, unless this process is a fork of the process that started them."""
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
