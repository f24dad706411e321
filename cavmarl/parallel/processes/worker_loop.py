"""The programs of the processes of a pool: the fork server, and the workers that it forks.

The pool starts the fork server as a program. The server has no threads; it makes the jobs of all
workers, with all kernels loaded, and forks a worker when the pool requests one. So a dead worker is
replaced in milliseconds by a successor that shares the prepared memory.

No process outlives the pool: the server ends with the process of the pool, or when its connection
to the pool is closed, and the system kills the workers with the server.
"""

from __future__ import annotations

import faulthandler
import gc
import json
import os
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, NoReturn

import numpy as np

from cavmarl.core.processes import die_with_parent
from cavmarl.core.tracebacks import traceback_text
from cavmarl.parallel.memory.shared_huge_pages import collapse_heap
from cavmarl.parallel.memory.shared_memory import Segment
from cavmarl.parallel.processes import process_barrier as barrier
from cavmarl.parallel.processes.process_barrier import NUMBER, WAKE, WORDS, WakeSignal, present_core
from cavmarl.parallel.state.state_image import Arrays, Image

# Words of the cache line that the pool writes, after the words of `process_barrier`: task, whether
# it has a payload, image to write (-1: none), committed image (-1: none), whether to resume from
# that image.
TASK, PAYLOAD, SLOT, COMMITTED, LOADS = 2, 3, 4, 5, 6
# Words of the cache line that a worker writes: how its command ended, and the core on which it
# began.
ANSWER, CORE = 2, 3
SILENT, ANSWERED, FAILED = 0, 1, 2

NOTHING = -1  # the task that does nothing
OUT_OF_MEMORY = 77  # exit status
MAX_MESSAGE = 1 << 17
MAIL = b"="  # starts a message with content
MAX_TRACEBACK = 16_000  # characters of at most six bytes; a longer traceback loses its start


class TeamFailedError(Exception):
    """A worker cannot go on because another worker of its team failed, which reports the reason.

    A team is a worker, or several workers that share the zones of one world.
    """


class Job:
    """The work of one worker."""

    def perform(
        self,
        task: int,  # number of the task, counted from 0 for each kind of job
        payload: Any,  # JSON value from the pool, often None
    ) -> Any:
        """Carry out a task, and return its answer as a JSON value; None: no answer."""
        raise NotImplementedError

    def save(self) -> Arrays:
        """Return what a successor needs to resume from here; empty if it needs nothing."""
        return []

    def load(self, saved: Sequence[Any]) -> None:
        """Resume from what `save` returned."""

    def on_idle(self) -> None:
        """Do work that the pool does not wait for, after the answer to a command was sent.

        The next command must not depend on this work: a successor that only has the committed state
        may carry out that command.
        """

    def before_fork(self) -> None:
        """Prepare, in the fork server, for the fork of a worker with this job.

        The previous worker with this job is dead. If it led a team, the whole team is dead.
        """


MakeJobs = Callable[[Mapping[str, Any]], Sequence[Job]]


def serve(make_jobs: MakeJobs) -> NoReturn:
    """Run the fork server until the pool is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the pool handles Ctrl-C, and ends all processes
    faulthandler.enable()
    start = json.loads(sys.argv[1])
    pool = socket.socket(fileno=start["pool"])
    parent = os.pidfd_open(start["parent"])
    if os.getppid() != start["parent"]:
        os._exit(0)
    try:
        message = _read(start["message"], start["message_bytes"])
        jobs = make_jobs(message)
        barrier.load_kernels()
        _refuse_threads()
    except Exception as error:
        send_to_pool(pool, describe(error))
        os._exit(1)
    gc.collect()
    gc.freeze()  # so that workers do not write to shared pages
    collapse_heap()
    send_to_pool(pool, {"ready": len(jobs)})
    _fork_on_demand(pool, parent, jobs, start)


def _refuse_threads() -> None:
    """Raise RuntimeError if this process has threads, which a fork would lose."""
    threads = len(os.listdir("/proc/self/task"))
    if threads > 1:
        names = [thread.name for thread in threading.enumerate()]
        raise RuntimeError(f"the fork server has {threads} threads; Python's threads are {names}")


def _read(fd: int, size: int) -> Any:
    return json.loads(os.pread(fd, size, 0))


def describe(error: BaseException) -> dict[str, str]:
    """Return the class, the message and the traceback of an exception, cut to size."""
    text = traceback_text(error)[-MAX_TRACEBACK:]
    message = str(error)[: MAX_TRACEBACK // 4]
    return {"kind": type(error).__name__, "text": message, "traceback": text}


def send_to_pool(pool: socket.socket, what: Mapping[str, Any]) -> None:
    """Send to the pool. If the pool is gone (Ctrl-C), the next read from its socket shows it."""
    with suppress(BrokenPipeError, ConnectionResetError):
        pool.send(json.dumps(what).encode())


def _fork_on_demand(
    pool: socket.socket, parent: int, jobs: Sequence[Job], start: Mapping[str, Any]
) -> NoReturn:
    poll = select.poll()
    poll.register(pool, select.POLLIN)
    poll.register(parent, select.POLLIN)
    alive: set[int] = set()
    while True:
        if any(fd == parent for fd, _ in poll.poll()):
            _end(alive)
        message, descriptors, _, _ = socket.recv_fds(pool, MAX_MESSAGE, 1)
        if not message:
            _end(alive)
        order = json.loads(message)
        if "reap" in order:
            pid = order["reap"]
            _, status = os.waitpid(pid, 0)
            alive.discard(pid)
            send_to_pool(pool, {"status": os.waitstatus_to_exitcode(status)})
            continue
        number, (wire,) = order["fork"], descriptors
        jobs[number].before_fork()
        server_pid = os.getpid()
        pid = os.fork()
        if pid == 0:
            die_with_parent()
            if os.getppid() != server_pid:
                os._exit(0)
            pool.close()
            os.close(parent)
            _work(number, jobs[number], socket.socket(fileno=wire), start)
        os.close(wire)
        alive.add(pid)
        send_to_pool(pool, {"pid": pid})


def _end(alive: set[int]) -> NoReturn:
    """End all workers, reap them, and exit, after the pool was closed."""
    for pid in alive:
        os.kill(pid, signal.SIGKILL)
    for pid in alive:
        os.waitpid(pid, 0)
    os._exit(0)


def _work(number: int, job: Job, wire: socket.socket, start: Mapping[str, Any]) -> NoReturn:
    cores = start["cores"]
    if cores:
        os.sched_setaffinity(0, {cores[number % len(cores)]})
    orders = np.frombuffer(Segment(start["orders"], 0).map(), dtype=np.int64)
    theirs = orders[number * WORDS : (number + 1) * WORDS]
    mine = np.frombuffer(Segment(start["statuses"][number], 0).map(), dtype=np.int64)[:WORDS]
    slots = [Image(Segment(fd, 0)) for fd in start["images"][number]]
    wake_signal = WakeSignal(mine, theirs, wire, start["crowded"])
    wake_signal.wake()  # a predecessor may have died asleep
    with suppress(BrokenPipeError, ConnectionResetError):  # the pool is gone
        _run_commands(job, wake_signal, slots)
    os._exit(0)


def _run_commands(job: Job, wake_signal: WakeSignal, slots: Sequence[Image]) -> NoReturn:
    mine, theirs = wake_signal.mine, wake_signal.theirs
    is_new = True
    wait_s = 0.0
    began = time.perf_counter()
    while True:
        order = int(mine[NUMBER]) + 1
        wait_s = _await(wake_signal, order, wait_s, time.perf_counter() - began)
        began = time.perf_counter()
        core = present_core()
        number, _, task, has_payload, slot, committed, loads, _ = theirs.tolist()
        payload = _receive(wake_signal.wire) if has_payload else None
        try:
            if (is_new or loads) and committed >= 0:
                dtypes = [array.dtype for array in job.save()]
                if dtypes:
                    job.load(list(slots[committed].read(dtypes)))
            is_new = False
            answer = None
            if task != NOTHING:
                answer = job.perform(task, payload)
            if slot >= 0 and (saved := job.save()):
                slots[slot].write(saved)
        except MemoryError:
            os._exit(OUT_OF_MEMORY)
        except Exception as error:
            mine[ANSWER] = FAILED
            wake_signal.wire.send(MAIL + json.dumps(describe(error)).encode())
        else:
            mine[ANSWER] = SILENT if answer is None else ANSWERED
            if answer is not None:
                wake_signal.wire.send(MAIL + json.dumps(answer).encode())
        mine[CORE] = core  # written this late, because the pool polls this cache line all the time
        wake_signal.post(number)
        if mine[ANSWER] != FAILED:
            try:
                job.on_idle()
            except MemoryError:
                os._exit(OUT_OF_MEMORY)


def _await(
    wake_signal: WakeSignal,  # shared with the pool
    order: int,  # number of the command
    last_s: float,  # duration of the last wait
    work_s: float,  # duration of the work since then
) -> float:
    """Wait for a command; exit if the pool is closed.

    Returns:
        the duration of the wait; `last_s` if the command had arrived before.
    """
    if wake_signal.has(order):
        return last_s
    began = time.perf_counter()
    if not wake_signal.watch(order, last_s, work_s):
        while wake_signal.sleep(order):
            # A payload may arrive before its command, so it stays unread.
            message = wake_signal.wire.recv(len(WAKE), socket.MSG_PEEK)
            wake_signal.wake()
            if not message:
                os._exit(0)
            if message == WAKE:
                wake_signal.wire.recv(len(WAKE))
    return time.perf_counter() - began


def _receive(wire: socket.socket) -> Any:
    while True:
        message = wire.recv(MAX_MESSAGE)
        if not message:
            os._exit(0)
        if message != WAKE:
            return json.loads(message[len(MAIL) :])
