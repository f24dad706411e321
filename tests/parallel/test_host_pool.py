"""Hosts that are killed, stopped, interrupted and left behind: none is missed."""

from __future__ import annotations

import gc
import os
import select
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import cavmarl.parallel.hosts.host_pool as pool_module
import cavmarl.parallel.hosts.listener as listener
from cavmarl.core.errors import WorkerDeathError, WorkerError, WorkerFailureError
from cavmarl.parallel.hosts.host_commands import HostProgram
from cavmarl.parallel.hosts.host_pool import HostPool
from cavmarl.parallel.hosts.listener import MAX_CALLERS, Listener
from tests.support.descriptors import without_descriptors
from tests.support.forks import said_in_fork
from tests.support.toy_hosts import ADD, DOZE, FAIL, FALL, TASKS, TOIL, TOTAL, WRITE, Processes

SIZES = (3, 2)
PROGRAM = HostProgram(("part 0", "part 1"), SIZES, TASKS, ADD, "toy")


class Adder:
    """Two hosts and what their totals ought to be."""

    def __init__(self, count: int, timeout_s: float, repeats: int, **recipe: Any) -> None:
        self.processes = Processes(count, **recipe)
        self.pool = HostPool(self.processes, PROGRAM, timeout_s, repeats)
        self.totals = [np.zeros(size) for size in SIZES]
        self.expected = [np.zeros(size) for size in SIZES]
        self.random = np.random.default_rng(0)

    def run(self, task: int = ADD) -> None:
        given = [self.random.normal(size=size) for size in SIZES]
        inputs = [[one] for one in given]
        self.pool.run(task, [None, None], inputs, lambda k, answer: [self.totals[k]])
        for k, one in enumerate(given):
            self.expected[k] = self.expected[k] + one if task == ADD else one
        self.check()

    def say(self, task: int, payload: Any = None) -> None:
        nothing: list[list[Any]] = [[], []]
        self.pool.run(task, [payload, payload], nothing, lambda k, answer: [])

    def check(self) -> None:
        for k in range(2):
            assert np.array_equal(self.totals[k], self.expected[k])
            assert self.pool.ask(k, TOTAL) == self.expected[k].sum()

    def kill(self, k: int, how: signal.Signals = signal.SIGKILL) -> None:
        os.kill(self.pool.pids[k], how)


Make = Callable[..., Adder]


@pytest.fixture
def make() -> Iterator[Make]:
    made: list[Adder] = []

    def call(count: int = 3, timeout_s: float = 60.0, repeats: int = 3, **recipe: Any) -> Adder:
        made.append(Adder(count, timeout_s, repeats, **recipe))
        return made[-1]

    yield call
    for adder in made:
        adder.pool.close()


def test_hosts_add_up(make: Make) -> None:
    adder = make()
    for step in range(25):
        adder.run(WRITE if step % 10 == 0 else ADD)
    adder.pool.ping()
    assert adder.pool.deaths == []


def test_a_fork_neither_orders_nor_ends_the_hosts(make: Make) -> None:
    adder = make()
    adder.run(WRITE)
    assert "the hosts are those of process" in said_in_fork(adder.pool.ping, adder.pool.close)
    adder.run()
    assert adder.pool.deaths == []


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_hosts_that_die_are_not_missed(make: Make, how: signal.Signals) -> None:
    adder = make()
    for step in range(15):
        adder.run(WRITE if step == 0 else ADD)
        if step % 7 == 3:
            adder.kill(step % 2, how)
    assert [death.worker for death in adder.pool.deaths] == [1, 0]
    for death in adder.pool.deaths:
        assert death.ordered_s <= death.noticed_s < death.ordered_s + 2.0
        assert death.noticed_s <= death.replaced_s <= death.done_s


def test_a_successor_that_first_did_nothing_knows_what_is_committed(make: Make) -> None:
    adder = make()
    adder.run(WRITE)
    adder.run()
    adder.kill(0)
    adder.pool.ping()
    adder.check()
    adder.run()
    assert len(adder.pool.deaths) == 1


def test_all_hosts_die_at_once(make: Make) -> None:
    adder = make(count=4)
    adder.run(WRITE)
    adder.run()
    for process in adder.processes.processes:
        process.kill()
    for _ in range(3):
        adder.run()
    assert len(adder.pool.deaths) >= 2


def test_an_exception_changes_nothing(make: Make) -> None:
    adder = make()
    adder.run(WRITE)
    adder.run()
    with pytest.raises(
        WorkerFailureError, match=r"(?s)worker 0 \(part 0\).*asked to fail"
    ) as caught:
        adder.say(FAIL)
    assert "in perform" in caught.value.traceback
    adder.check()
    adder.run()


def test_an_order_that_everybody_dies_of(make: Make) -> None:
    adder = make(repeats=1)
    adder.run(WRITE)
    with pytest.raises(WorkerDeathError, match=r"its fall .*2 processes died") as caught:
        adder.say(FALL, adder.pool.pids[1])
    assert caught.value.worker == 0
    with pytest.raises(WorkerError, match="closed"):
        adder.run()


def test_who_sleeps_is_replaced_and_who_works_is_not(make: Make) -> None:
    adder = make()
    adder.run(WRITE)
    adder.say(TOIL, 1.5)
    assert adder.pool.deaths == []
    adder.say(DOZE, adder.pool.pids[:1])
    assert [death.worker for death in adder.pool.deaths] == [0]
    assert "silent" in adder.pool.deaths[0].cause
    adder.run()


def test_who_works_for_too_long_is_replaced(make: Make) -> None:
    adder = make(timeout_s=1.0, repeats=0)
    adder.run(WRITE)
    with pytest.raises(WorkerDeathError, match=r"not done after workers.timeout_s = 1"):
        adder.say(TOIL, 30.0)


def test_an_interruption_leaves_what_was_committed(make: Make) -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    adder = make()
    adder.run(WRITE)
    adder.run()
    timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        adder.say(TOIL, 1.0)
    signal.signal(signal.SIGINT, before)
    adder.check()
    adder.run()
    assert adder.pool.deaths == []


def test_strangers_at_the_door_disturb_nobody(make: Make) -> None:
    adder = make()
    adder.run(WRITE)
    callers = [socket.create_connection(adder.processes.place) for _ in range(3)]
    callers[0].sendall(b"GET / HTTP/1.1\r\n\r\n" * 100)
    callers[1].close()
    for _ in range(5):
        adder.run()
    callers[0].settimeout(5.0)
    with pytest.raises(ConnectionError):
        callers[0].recv(1)
    for caller in callers:
        caller.close()
    assert adder.pool.deaths == []


def test_a_crowd_at_the_door_does_not_keep_a_successor_out(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(listener, "GREETING_S", 600.0)  # the silent ones leave for no other reason
    adder = make(count=2)
    adder.run(WRITE)
    crowd = [socket.create_connection(adder.processes.place) for _ in range(3 * MAX_CALLERS)]
    adder.run()
    adder.kill(0)
    adder.run()
    assert len(adder.pool.deaths) == 1
    for caller in crowd:
        caller.close()


def test_a_door_without_descriptors_hangs_up_and_is_not_readable_for_ever() -> None:
    door = Listener("127.0.0.1")
    waiting = [socket.create_connection(door.place) for _ in range(2)]
    with without_descriptors():
        assert door.admit() == []
        assert not select.select([door], [], [], 0.05)[0]
    for caller in waiting:
        caller.settimeout(5.0)
        assert caller.recv(1) == b""
        caller.close()
    later = socket.create_connection(door.place)
    door.admit()
    assert len(door._callers) == 1
    later.close()
    door.close()


def test_a_job_that_cannot_be_made() -> None:
    processes = Processes(2, error="no map here")
    with pytest.raises(WorkerFailureError, match="no map here"):
        HostPool(processes, PROGRAM, 60.0, 3)
    assert all(process.poll() is not None for process in processes.processes)


def test_hosts_of_other_code_are_refused() -> None:
    processes = Processes(2, code="another")
    with pytest.raises(WorkerError, match="runs another, this machine toy: install the same"):
        HostPool(processes, PROGRAM, 60.0, 3)
    assert all(process.poll() is not None for process in processes.processes)


def test_hosts_that_do_not_come(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool_module, "COMES_S", 1.0)
    processes = Processes(1)
    with pytest.raises(WorkerError, match=r"[01] of 2 are there.*within 1 s; ray status"):
        HostPool(processes, PROGRAM, 60.0, 3)
    monkeypatch.undo()
    processes = Processes(1)
    processes.words = "no way to the caller"
    with pytest.raises(WorkerError, match="no way to the caller"):
        HostPool(processes, PROGRAM, 60.0, 3)


def test_hosts_end_with_their_pool(make: Make) -> None:
    adder = make()
    processes = adder.processes.processes
    adder.pool.close()
    assert all(process.poll() is not None for process in processes)
    forgotten = Adder(2, 60.0, 3)
    processes = forgotten.processes.processes
    del forgotten
    gc.collect()
    assert all(process.poll() is not None for process in processes)


def test_a_host_ends_with_its_connection(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    adder = make()
    adder.run(WRITE)
    processes = list(adder.processes.processes)
    monkeypatch.setattr(adder.processes, "close", lambda: None)  # the caller was killed
    adder.pool.close()
    until_s = time.monotonic() + 5.0
    while time.monotonic() < until_s and any(process.poll() is None for process in processes):
        time.sleep(0.05)
    assert all(process.poll() is not None for process in processes)


def test_an_image_is_taken_now_and_then(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool_module, "IMAGE_EVERY", 2)
    adder = make()
    for step in range(9):
        adder.run(WRITE if step == 0 else ADD)
        if step == 3:
            adder.kill(0)
    assert len(adder.pool.deaths) == 1
