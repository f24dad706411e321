"""`HostPool`: hosts that do one job together, command by command, and survive their deaths.

It is `processes.worker_pool` for processes that share no memory with the caller. So the caller
keeps what they leave behind: of each part an image of its state, every few commands, and the inputs
of the orders since. When all hosts have carried out an order, the pool commits it. The part of one
that is gone is given to a host that is free, with the image and those inputs: it reads the same and
does the same.
"""

from __future__ import annotations

import os
import signal
import time
import weakref
from collections.abc import Callable, Sequence
from math import isnan, nan
from typing import Any

import numpy as np

from cavmarl.core.errors import MessageError, WorkerDeathError, WorkerError, WorkerFailureError
from cavmarl.core.processes import is_fork, refuse_fork
from cavmarl.parallel.hosts.framed_socket import Frame, Kind
from cavmarl.parallel.hosts.host_commands import Arrays, CommittedState, HostProgram, OpenOrder, Say
from cavmarl.parallel.hosts.host_process import Order
from cavmarl.parallel.hosts.host_registry import (
    ENDED,
    SILENCE_S,
    HostConnection,
    HostRegistry,
    Launcher,
)
from cavmarl.parallel.processes.watchdog import CHECK_S
from cavmarl.parallel.processes.worker_loop import NOTHING
from cavmarl.parallel.processes.worker_pool import Death

COMES_S = 300.0  # a machine that has never run cavmarl compiles it first
IMAGE_EVERY = 8  # commands that are noted: a successor repeats as many at most


class HostPool:
    """m parts of a job over at least as many hosts.

    Raises:
        WorkerError: they do not come.
        WorkerFailureError: an exception while they made their jobs.
    """

    def __init__(
        self, launcher: Launcher, program: HostProgram, timeout_s: float, repeats: int
    ) -> None:
        self.deaths: list[Death] = []  # all that there were of hosts with a part
        self._launcher = launcher
        self._program = program
        self._timeout_s = timeout_s
        self._repeats = repeats
        self._all = tuple(range(len(program.parts)))
        self._names = program.parts
        self._committed = [CommittedState(size) for size in program.sizes]
        self._hosts: dict[int, HostConnection] = {}
        self._number = 0
        self._open: OpenOrder | None = None
        self._company = HostRegistry(launcher, program.code)
        self._pid = os.getpid()
        self._finalizer = weakref.finalize(self, _close, self._company, self._pid)
        try:
            self._await_first()
        except BaseException:
            self.close()
            raise

    @property
    def pids(self) -> list[int]:
        """Of the processes of all parts, each on its machine."""
        return [self._hosts[k].pid for k in self._all]

    @property
    def machines(self) -> list[str]:
        return [self._hosts[k].machine for k in self._all]

    @property
    def sizes(self) -> tuple[int, ...]:
        return tuple(committed.size for committed in self._committed)

    def rename(self, names: Sequence[str]) -> None:
        self._names = tuple(names)

    def signal(self, part: int, how: signal.Signals) -> bool:  # whether there is one at the moment
        """Send a signal to the process of a part, which has to be on this machine."""
        host = self._hosts.get(part)
        if host is not None:
            os.kill(host.pid, how)
        return host is not None

    def team_of(self, worker: int) -> tuple[int, ...]:
        """The workers replaced with a worker, itself among them."""
        return (worker,)

    def run(
        self,
        task: int,
        payloads: Sequence[Any],  # what is said to each part, as JSON knows it
        inputs: Sequence[Arrays],  # arrays for each part
        # part, answer → arrays that what comes out is written to
        outputs: Callable[[int, Any], Arrays],
        commits: bool = True,  # the task changes their state
        # of the parts after it, where it changes them; such a task is not the noted one
        sizes: Sequence[int] | None = None,
    ) -> list[Any]:  # what each part has answered
        """Let all hosts do a task.

        Raises:
            WorkerDeathError: too many hosts died of it; the pool is closed.
            WorkerError: there is no host left, and none comes; the pool is closed.
            WorkerFailureError: an exception in a host; all are as they were before.
        """
        return self._command(self._all, task, _said(payloads, inputs), outputs, commits, sizes)

    def ask(self, part: int, task: int, payload: Any = None) -> Any:
        """Let the host of one part do a task that changes nothing; raises as `run`."""
        payloads = [payload] * len(self._all)
        nothing: list[Arrays] = [()] * len(self._all)
        return self._command((part,), task, _said(payloads, nothing), _no_arrays, False)[0]

    def ping(self) -> None:
        """Let all hosts do nothing: an empty barrier."""
        self._command(self._all, NOTHING, _say_nothing, _no_arrays, False)

    def await_spare(self) -> None:
        """Return when there is a host that would take up a part at once.

        Raises:
            WorkerError: none comes; the pool is closed.
        """
        began = time.monotonic()
        nothing = OpenOrder(
            self._number, NOTHING, _say_nothing, _no_arrays, sizes=(), saves=False, ordered_s=began,
            first_death=len(self.deaths), pending=set(), is_void=True,
        )  # fmt: skip
        while not self._company.free:
            for host in self._look():
                self._hear(nothing, host)
            self._complain(time.monotonic() - began, "to spare")

    def close(self) -> None:
        self._finalizer()

    def _command(
        self,
        parts: tuple[int, ...],
        task: int,
        say: Say,
        outputs: Callable[[int, Any], Arrays],
        commits: bool,
        sizes: Sequence[int] | None = None,
    ) -> list[Any]:
        if not self._finalizer.alive:
            raise WorkerError("the hosts are closed: make the environment anew")
        refuse_fork(self._pid, "the hosts")
        if self._open is not None:
            self._settle(self._open)
        is_full = len(self._committed[0].since) == IMAGE_EVERY
        self._number += 1
        order = self._open = OpenOrder(
            self._number, task, say, outputs, self.sizes if sizes is None else sizes,
            saves=commits and (task != self._program.noted or is_full),
            ordered_s=time.monotonic(), first_death=len(self.deaths), pending=set(parts),
        )  # fmt: skip
        for k in parts:
            if k in self._hosts:
                self._give(order, k, self._hosts[k])
        self._await(order)
        if order.failure is not None:
            self._open = None
            raise order.failure
        if commits:  # at once: an interruption finds the one state or the other
            self._committed = [self._committed[k].after(order, k) for k in parts]
        self._open = None
        for k in parts if task != NOTHING else ():
            self._hosts[k].knows = not self._hosts[k].is_gone
        return [order.answers[k] for k in parts]

    def _settle(self, order: OpenOrder) -> None:
        """Let a command end that was interrupted; it is not committed."""
        order.is_void = True
        order.pending &= self._hosts.keys()
        for k, host in list(self._hosts.items()):
            if host.wire.is_torn:
                self._lose(order, k, "interrupted", restart=True)
        self._await(order)
        self._open = None

    def _await(self, order: OpenOrder) -> None:
        next_s = order.ordered_s + CHECK_S
        while order.pending:
            for k in sorted(order.pending - self._hosts.keys()):
                if self._company.free:
                    self._give(order, k, self._choose(k))
            for host in self._look():
                self._hear(order, host)
            if order.pending and time.monotonic() > next_s:
                next_s = time.monotonic() + CHECK_S
                self._check(order)

    def _look(self) -> list[HostConnection]:
        try:
            return self._company.look(CHECK_S)
        except WorkerError:
            self.close()
            raise

    def _choose(self, part: int) -> HostConnection:
        """A host that is free; the one that was started for the part, if it is there."""
        free = self._company.free
        host = min(free, key=lambda one: (one.number != part, one.number))
        free.remove(host)
        self._hosts[part] = host
        return host

    def _give(self, order: OpenOrder, k: int, host: HostConnection) -> None:
        """Give a host the command, and what is committed if it does not know it."""
        program, committed = self._program, self._committed[k]
        is_behind = not host.knows and order.task != NOTHING
        before = [committed.image, *committed.since] if is_behind and committed.image.size else []
        said, inputs = order.say(k, host.knows)
        payload = Order(
            order.task, said, size=committed.size, image=before[0].size if before else 0,
            repeats=max(len(before) - 1, 0), repeated=program.noted, saves=order.saves,
        )  # fmt: skip
        host.part, host.knows = k, host.knows and order.task == NOTHING
        host.given_s = host.heard_s = time.monotonic()
        try:
            if host.is_gone:
                raise EOFError
            host.wire.send(Kind.ORDER, order.number, payload, [*before, *inputs])
            host.heard_s = time.monotonic()  # it has read most of it
        except (EOFError, OSError) as error:
            self._lose(order, k, _words(error), restart=False)
            return
        for death in self.deaths[order.first_death :]:
            if death.worker == k and isnan(death.replaced_s):
                death.replaced_s = host.given_s

    def _hear(self, order: OpenOrder, host: HostConnection) -> None:
        k = host.part
        try:
            frame = host.wire.receive()
            host.heard_s = time.monotonic()
            if frame.kind == Kind.BEAT or frame.order != order.number:
                host.wire.skip()
            elif frame.kind == Kind.FAILED or order.is_void:
                host.wire.skip()
                self._fail(order, k, frame)
            else:
                self._take(order, k, host, frame)
        except (EOFError, OSError, MessageError) as error:
            if k in order.pending:
                self._lose(order, k, _words(error), restart=not isinstance(error, ENDED))
            else:
                self._company.mute(host)  # it is missed with the next order

    def _take(self, order: OpenOrder, k: int, host: HostConnection, frame: Frame) -> None:
        answer, saved = frame.payload["answer"], np.empty(frame.payload["image"], dtype=np.uint8)
        host.wire.take([*order.outputs(k, answer), saved])
        order.answers[k], order.images[k] = answer, saved
        order.pending.discard(k)
        for death in self.deaths[order.first_death :]:
            if death.worker == k and isnan(death.done_s):
                death.done_s = host.heard_s

    def _fail(self, order: OpenOrder, k: int, frame: Frame) -> None:
        order.pending.discard(k)
        first = order.failure is None or k < order.failure.worker
        if frame.kind == Kind.FAILED and first:
            order.failure = WorkerFailureError(k, self._names[k], **frame.payload)

    def _lose(self, order: OpenOrder, k: int, cause: str, restart: bool) -> None:
        """A host is gone, or taken for it: another one goes on in its place."""
        host = self._hosts.pop(k)
        self._company.drop(host, restart)
        if order.is_void:
            order.pending.discard(k)
            return
        now = time.monotonic()
        said = f"{host}: {cause}"
        self.deaths.append(Death(k, order.number, said, order.ordered_s, now, nan))
        causes = [one.cause for one in self.deaths[order.first_death :] if one.worker == k]
        if len(causes) > self._repeats:
            self.close()
            what = "nothing" if order.task == NOTHING else self._program.tasks[order.task]
            raise WorkerDeathError(k, self._names[k], order.number, what, causes)

    def _check(self, order: OpenOrder) -> None:
        now = time.monotonic()
        for k in sorted(order.pending):
            host = self._hosts.get(k)
            if host is None:
                missed_s = max((one.noticed_s for one in self.deaths), default=0.0)
                waited_s = now - max(missed_s, order.ordered_s)
                self._complain(waited_s, f"for {self._names[k]}")
            elif now - host.heard_s > SILENCE_S:
                self._lose(order, k, f"silent for {now - host.heard_s:.1f} s", restart=True)
            elif now - host.given_s > self._timeout_s:
                why = f"not done after workers.timeout_s = {self._timeout_s:g}"
                self._lose(order, k, why, restart=True)

    def _await_first(self) -> None:
        """Return when those are there that were started for the parts."""
        began = time.monotonic()
        missing = set(self._all)
        while missing:
            self._company.look(CHECK_S)
            missing = set(self._all) - {host.number for host in self._company.free}
            there = f"{len(self._all) - len(missing)} of {len(self._all)} are there"
            self._complain(time.monotonic() - began, there)

    def _complain(self, waited_s: float, where: str) -> None:
        """Give up if no host will come."""
        trouble = self._launcher.trouble()
        if trouble is None and waited_s > COMES_S:
            trouble = f"none has come within {COMES_S:g} s; ray status tells what Ray waits for"
        if trouble is not None:
            self.close()
            raise WorkerError(f"no host ({where}): {trouble}")


def _close(company: HostRegistry, pid: int) -> None:
    """End the hosts; a fork of the pool's process has no right to."""
    if not is_fork(pid):
        company.close()


def _said(payloads: Sequence[Any], inputs: Sequence[Arrays]) -> Say:
    return lambda k, knows: (payloads[k], inputs[k])


def _say_nothing(part: int, knows: bool) -> tuple[None, Arrays]:
    return None, ()


def _no_arrays(part: int, answer: Any) -> Arrays:
    return ()


def _words(error: Exception) -> str:
    return str(error) or "its connection has ended"
