"""The programs of a pool's processes: the fork server, and the workers that it forks.

The pool starts one process as a program. That one makes every worker's job ready, with all kernels
loaded, and has no threads; then it forks a worker whenever the pool asks for one. So a worker that
has died is replaced in milliseconds, and its successor begins with what is ready.

No process outlives the pool: the forking process ends when the pool's process does, or when it
hears no more of it, and the system kills the workers with the process that forked them.
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

# Words of the pool's line, behind those of `barrier`.
TASK, PAYLOAD, SLOT, COMMITTED, LOADS = 2, 3, 4, 5, 6
# Words of the worker's line: how its command ended, and on which core it began it.
ANSWER, CORE = 2, 3
SILENT, ANSWERED, FAILED = 0, 1, 2

NOTHING = -1  # a task: to be there
OUT_OF_MEMORY = 77  # exit status
MAX_MESSAGE = 1 << 17
MAIL = b"="  # begins a message with something in it
MAX_TRACEBACK = 16_000  # characters, six bytes each at most; the end of a longer one is sent


class TeamFailedError(Exception):
    """A worker cannot go on because another one of its team failed; that one reports why."""


class Job:
    """What one worker does."""

    def perform(
        self,
        task: int,  # which one; numbers from 0 on are the job's own
        payload: Any,  # what the pool has to say to it, as JSON knows it; mostly nothing
    ) -> Any:
        """Do a task; the answer, as JSON knows it, of those that have one."""
        raise NotImplementedError

    def save(self) -> Arrays:
        """All that a successor needs to go on from here; nothing if there is no such thing."""
        return []

    def load(self, saved: Sequence[Any]) -> None:
        """Go on from what `save` gave."""

    def on_idle(self) -> None:
        """Called after a command's answer is sent: for work that is not waited for.

        What it makes must not be needed before another command is carried out: that one may be
        carried out by a successor, which finds what was committed.
        """

    def before_fork(self) -> None:
        """Called where workers are forked, before each fork that is to do this job.

        The worker that did it is dead; so are those it shares memory with, if it is their first.
        """


MakeJobs = Callable[[Mapping[str, Any]], Sequence[Job]]


def serve(make_jobs: MakeJobs) -> NoReturn:
    """The whole life of the forking process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the pool, which sees to the rest
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
        _send(pool, describe(error))
        os._exit(1)
    gc.collect()
    gc.freeze()  # what is ready is not moved around by workers
    collapse_heap()
    _send(pool, {"ready": len(jobs)})
    _fork_on_demand(pool, parent, jobs, start)


def _refuse_threads() -> None:
    """A process with threads must not fork."""
    threads = len(os.listdir("/proc/self/task"))
    if threads > 1:
        names = [thread.name for thread in threading.enumerate()]
        raise RuntimeError(f"a process that forks has {threads} threads, of Python's: {names}")


def _read(fd: int, size: int) -> Any:
    return json.loads(os.pread(fd, size, 0))


def describe(error: BaseException) -> dict[str, str]:
    """An exception in words, not too many: its class, its message, its traceback."""
    text = traceback_text(error)[-MAX_TRACEBACK:]
    message = str(error)[: MAX_TRACEBACK // 4]
    return {"kind": type(error).__name__, "text": message, "traceback": text}


def _send(pool: socket.socket, what: Mapping[str, Any]) -> None:
    """Tell the pool; that it is gone (Ctrl-C) is seen when its socket is read."""
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
            _send(pool, {"status": os.waitstatus_to_exitcode(status)})
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
        _send(pool, {"pid": pid})


def _end(alive: set[int]) -> NoReturn:
    """The pool is closed: nothing is left behind, not even a zombie."""
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
        mine[CORE] = core  # now, and not before: the pool polls this line all the time
        wake_signal.post(number)
        if mine[ANSWER] != FAILED:
            try:
                job.on_idle()
            except MemoryError:
                os._exit(OUT_OF_MEMORY)


def _await(
    wake_signal: WakeSignal,  # with the pool
    order: int,
    last_s: float,  # how long the last wait was that was one
    work_s: float,  # how long was worked since
) -> float:  # how long the last wait was, which may be this one
    """Return when there is a command; end with the pool."""
    if wake_signal.has(order):
        return last_s
    began = time.perf_counter()
    if not wake_signal.watch(order, last_s, work_s):
        while wake_signal.sleep(order):
            # A payload may come before its command: it is left where it is.
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
