"""Processes that are killed, stopped, interrupted and left behind: none is missed."""

from __future__ import annotations

import gc
import os
import random
import resource
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import cavmarl.parallel.processes.process_barrier as barrier
from cavmarl.core.errors import (
    WorkerDeathError,
    WorkerError,
    WorkerFailureError,
)
from cavmarl.parallel.processes import worker_loop
from cavmarl.parallel.processes.shared_memory import Segment
from cavmarl.parallel.processes.worker_pool import Pool, Program
from tests.support.forks import said_in_fork
from tests.support.toiling import toiling
from tests.support.toy_job import ADD, DIE, DOZE, FAIL, FALL, POINTS, RUN_OUT, TASKS, TOIL, TOTAL

MODULE = "tests.support.toy_job"
ROOT = Path(__file__).resolve().parents[2]
MORE = 1000  # numbers that each task adds

Make = Callable[..., Pool]


def program(workers: int = 2, teams: tuple[tuple[int, ...], ...] = (), **recipe: object) -> Program:
    names = tuple(f"part {k}" for k in range(workers))
    return Program(MODULE, {"workers": workers, **recipe}, names, (), TASKS, teams=teams)


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C arrives, also where these tests were started in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def make() -> Iterator[Make]:
    pools: list[Pool] = []

    def call(
        workers: int = 2,
        timeout_s: float = 60.0,
        repeats: int = 3,
        teams: tuple[tuple[int, ...], ...] = (),
    ) -> Pool:
        pools.append(Pool(program(workers, teams), timeout_s, repeats))
        return pools[-1]

    yield call
    for pool in pools:
        pool.close()


def interrupt() -> None:
    signal.raise_signal(signal.SIGINT)


def totals(pool: Pool) -> list[list[float]]:
    return pool.run(TOTAL, commits=False)


def alive(pids: list[int]) -> list[int]:
    """Those that are there, and be it as a zombie of ours."""
    return [pid for pid in pids if Path(f"/proc/{pid}").exists()]


def gone(pids: list[int], limit_s: float = 60.0) -> bool:
    end = time.monotonic() + limit_s
    while alive(pids) and time.monotonic() < end:
        time.sleep(0.01)
    return not alive(pids)


def test_all_work_and_answer(make: Make) -> None:
    pool = make(workers=2)
    for _ in range(3):
        pool.run(ADD)
    assert totals(pool) == [[9.0, 3 * MORE]] * 2
    assert pool.ask(1, TOTAL) == [9.0, 3 * MORE]
    assert pool.deaths == []


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM])
def test_one_that_dies_while_nobody_waits(make: Make, how: signal.Signals) -> None:
    pool = make(workers=2)
    pool.run(ADD)
    os.kill(pool.pids[1], how)
    pool.run(ADD)
    assert totals(pool) == [[6.0, 2 * MORE]] * 2
    assert [death.worker for death in pool.deaths] == [1]
    assert how.name in pool.deaths[0].cause


def test_one_that_dies_before_the_first_order(make: Make) -> None:
    pool = make(workers=1)
    os.kill(pool.pids[0], signal.SIGKILL)
    pool.run(ADD)
    assert totals(pool) == [[3.0, MORE]]


def test_all_that_die_at_work(make: Make, tmp_path: Path) -> None:
    pool = make(workers=2)
    pool.run(ADD)
    pids = pool.pids
    with toiling(tmp_path, 2, lambda: [os.kill(pid, signal.SIGKILL) for pid in pids]) as place:
        pool.run(TOIL, place)
    assert totals(pool) == [[6.0, 2 * MORE]] * 2
    assert sorted(death.worker for death in pool.deaths) == [0, 1]
    for death in pool.deaths:
        assert death.ordered_s < death.noticed_s < death.replaced_s < death.done_s


@pytest.mark.parametrize("point", range(len(POINTS)), ids=POINTS)
def test_one_that_dies_at_a_point_of_an_order(make: Make, point: int, tmp_path: Path) -> None:
    pool = make(workers=2)
    pool.run(ADD)
    (tmp_path / "trap").touch()
    pool.run(FALL, [point, str(tmp_path / "trap")])
    assert totals(pool) == [[6.0, 2 * MORE]] * 2
    assert [death.cause for death in pool.deaths] == ["SIGKILL"]
    pool.run(ADD)
    assert totals(pool) == [[9.0, 3 * MORE]] * 2


def test_an_image_that_is_not_what_was_written_is_refused(make: Make) -> None:
    pool = make(workers=1)
    pool.run(ADD)
    image = pool._processes._held.segments[2 + pool._committed].map()
    image[200] ^= 1
    os.kill(pool.pids[0], signal.SIGKILL)
    with pytest.raises(WorkerFailureError, match="not what it wrote"):
        pool.run(ADD)


def test_the_answer_of_one_that_dies_after_it_is_not_lost(make: Make, tmp_path: Path) -> None:
    pool = make(workers=2)
    pool.run(ADD)
    first, second = pool.pids
    with toiling(tmp_path, 1, lambda: os.kill(first, signal.SIGKILL)) as place:
        pool.ask(1, TOIL, place)  # it counts in the second alone, and is not committed
    assert pool.pids[1] == second
    assert pool.ask(0, TOTAL) == [3.0, MORE]


@pytest.mark.parametrize("dying", [0, 1])
def test_a_team_is_replaced_as_a_whole(make: Make, dying: int, tmp_path: Path) -> None:
    pool = make(workers=3, teams=((0, 1),))
    pool.run(ADD)
    before = pool.pids
    with toiling(tmp_path, 3, lambda: os.kill(before[dying], signal.SIGKILL)) as place:
        pool.run(TOIL, place)
    assert totals(pool) == [[6.0, 2 * MORE]] * 3
    assert [pid in before for pid in pool.pids] == [False, False, True]
    assert [death.worker for death in pool.deaths] == [dying]
    assert alive(before[:2]) == []


def test_who_has_no_order_gets_none_when_its_team_is_replaced(make: Make) -> None:
    pool = make(workers=2, teams=((0, 1),))
    pool.run(ADD)
    os.kill(pool.pids[1], signal.SIGKILL)
    assert pool.ask(0, TOTAL) == [3.0, MORE]
    pool.run(ADD)
    assert totals(pool) == [[6.0, 2 * MORE]] * 2


@pytest.mark.usefixtures("interruptible")
def test_a_team_that_loses_somebody_while_its_order_is_given_up(make: Make, tmp_path: Path) -> None:
    pool = make(workers=2, teams=((0, 1),))
    pool.run(ADD)
    pids = pool.pids
    with toiling(tmp_path, 2, interrupt, ends=False) as place:
        with pytest.raises(KeyboardInterrupt):
            pool.run(TOIL, place)
        os.kill(pids[1], signal.SIGKILL)
    assert totals(pool) == [[3.0, MORE]] * 2


def test_one_that_is_slow_is_let_be(make: Make) -> None:
    pool = make(workers=1)
    pool.run(TOIL, 1.5)
    assert pool.deaths == []


def test_one_that_hangs_is_noticed_after_less_than_a_second_of_sleep(make: Make) -> None:
    pool = make(workers=2, repeats=0)
    with pytest.raises(WorkerDeathError, match=r"worker 0 \(part 0\).*doze.*asleep for 0\.8 s"):
        pool.run(DOZE, 60.0)


def test_one_that_toils_too_long_is_noticed(make: Make) -> None:
    pool = make(workers=1, timeout_s=0.5, repeats=0)
    with pytest.raises(WorkerDeathError, match=r"workers\.timeout_s = 0\.5"):
        pool.run(TOIL, 60.0)


@pytest.mark.parametrize(
    ("task", "payload", "cause"),
    [(DIE, int(signal.SIGKILL), "SIGKILL"), (RUN_OUT, None, "out of memory")],
)
def test_a_task_that_everybody_dies_of(
    make: Make, task: int, payload: int | None, cause: str
) -> None:
    pool = make(workers=2, repeats=2)
    pids = [*pool.pids, pool.server_pid]
    with pytest.raises(WorkerDeathError, match=TASKS[task]) as caught:
        pool.run(task, payload)
    assert caught.value.causes == (cause,) * 3
    assert gone(pids)
    with pytest.raises(WorkerError, match="closed"):
        pool.run(ADD)


def test_an_exception_arrives_whole_and_changes_nothing(make: Make) -> None:
    pool = make(workers=2)
    pool.run(ADD)
    with pytest.raises(WorkerFailureError, match="as told: so it goes") as caught:
        pool.run(FAIL, "so it goes")
    assert caught.value.kind == "ValueError"
    assert "toy_job.py" in caught.value.traceback
    assert totals(pool) == [[3.0, MORE]] * 2
    pool.run(ADD)
    assert totals(pool) == [[6.0, 2 * MORE]] * 2


@pytest.mark.usefixtures("interruptible")
def test_an_interrupted_order_is_not_committed(make: Make, tmp_path: Path) -> None:
    pool = make(workers=2)
    pool.run(ADD)
    with toiling(tmp_path, 2, interrupt, ends=False) as place, pytest.raises(KeyboardInterrupt):
        pool.run(TOIL, place)
    assert totals(pool) == [[3.0, MORE]] * 2
    assert pool.deaths == []


def test_the_process_that_forks_may_die_or_be_stopped(make: Make) -> None:
    pool = make(workers=2)
    pool.run(ADD)
    os.kill(pool.server_pid, signal.SIGKILL)
    assert gone_soon(pool.pids)
    pool.run(ADD)
    assert totals(pool) == [[6.0, 2 * MORE]] * 2
    os.kill(pool.server_pid, signal.SIGSTOP)
    os.kill(pool.pids[0], signal.SIGKILL)
    pool.run(ADD)
    assert totals(pool) == [[9.0, 3 * MORE]] * 2


def test_a_server_whose_pool_has_gone_says_nothing() -> None:
    """Ctrl-C ends the pool while the server starts: no traceback of it is shown."""
    pool, server = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    pool.close()
    worker_loop._say(server, {"ready": 1})
    assert server.recv(10) == b""  # by which the server ends
    server.close()


def test_a_start_that_is_killed_is_begun_again(tmp_path: Path) -> None:
    files = [str(tmp_path / name) for name in "abc"]
    for file in files[:2]:
        Path(file).touch()
    pool = Pool(program(2, dies_while=files), 60.0, 2)
    pool.run(ADD)
    assert totals(pool) == [[3.0, MORE]] * 2
    for file in files:
        Path(file).touch()
    pids = pool.pids
    os.kill(pool.server_pid, signal.SIGKILL)
    assert gone_soon(pids)
    descriptors = len(os.listdir("/proc/self/fd"))
    with pytest.raises(WorkerError, match=r"ended 3 times .* SIGKILL, SIGKILL, SIGKILL"):
        pool.run(ADD)
    assert gone(pids)
    assert len(os.listdir("/proc/self/fd")) < descriptors


def test_a_start_that_is_stopped_is_begun_again(tmp_path: Path) -> None:
    file = tmp_path / "a"
    file.touch()
    start = program(2, dies_while=[str(file)], dies_by=signal.SIGSTOP)
    pool = in_time(lambda: Pool(start, 60.0, 2))
    pool.run(ADD)
    assert totals(pool) == [[3.0, MORE]] * 2
    file.touch()
    os.kill(pool.server_pid, signal.SIGKILL)
    in_time(lambda: pool.run(ADD))
    assert totals(pool) == [[6.0, 2 * MORE]] * 2
    pool.close()


def in_time(work: Callable[[], Any], limit_s: float = 20.0) -> Any:
    """What `work` returns; SIGALRM ends it, where it waits for ever."""

    def give_up(*_: object) -> None:
        raise TimeoutError(f"not done after {limit_s:g} s")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        return work()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def test_a_pool_of_another_thread_ends_with_the_process_and_not_before() -> None:
    text = LONER.format(root=str(ROOT), then="").replace(
        "pool = Pool(program(2), 60.0, 3)",
        "from concurrent.futures import Future\nfrom threading import Thread\nmade = Future()\n"
        "maker = Thread(target=lambda: made.set_result(Pool(program(2), 60.0, 3)))\n"
        "maker.start()\nmaker.join()\npool = made.result()",
    )
    text += "import os\nos.kill(pool.server_pid, signal.SIGSTOP)\npool.run(ADD)\n"
    text += "os.kill(os.getpid(), signal.SIGKILL)\n"
    loner = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
    pids = [int(word) for word in loner.stdout.split()]
    assert loner.returncode == -signal.SIGKILL, loner.stderr
    assert len(pids) == 3
    assert gone_soon(pids)  # also the one that was stopped


def gone_soon(pids: list[int]) -> bool:
    """Whether all have ended, buried or not."""
    for pid in pids:
        try:
            pidfd = os.pidfd_open(pid)
        except ProcessLookupError:
            continue
        ended = bool(select.select([pidfd], [], [], 60.0)[0])
        os.close(pidfd)
        if not ended:
            return False
    return True


def test_no_call_to_wake_up_is_missed(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(barrier, "SHORT_S", 0.0)
    monkeypatch.setattr(barrier, "LONG_S", 0.0)
    monkeypatch.setattr(barrier, "_look", lambda theirs, number, yields: False)
    pool = make(workers=2)
    rng = random.Random(0)
    for _ in range(1000):
        time.sleep(rng.uniform(0.0, 1e-4))
        pool.ping()
    assert pool.deaths == []


def test_nothing_is_burnt_while_nobody_asks(make: Make) -> None:
    pool = make(workers=2)
    for _ in range(1000):
        pool.ping()
    while any(stat_of(pid)[0] != "S" for pid in pool.pids):
        time.sleep(0.001)  # they look for orders for a while before they sleep
    before = [ticks(pid) for pid in pool.pids]
    time.sleep(0.5)
    assert [ticks(pid) for pid in pool.pids] == before


def ticks(pid: int) -> int:
    return int(stat_of(pid)[11]) + int(stat_of(pid)[12])


def stat_of(pid: int) -> list[str]:
    """Of a process: state, parent and so on."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def maps(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/maps").read_text().splitlines()


@pytest.mark.parametrize("way", ["close", "forget"])
def test_nothing_is_left_behind(way: str) -> None:
    gc.collect()  # what other tests have left
    files = len(os.listdir("/proc/self/fd"))
    pool = Pool(program(3), 60.0, 3)
    pool.run(ADD)
    pids = [*pool.pids, pool.server_pid]
    shared = [line for pid in pids for line in maps(pid) if "rw-s" in line]
    assert shared
    assert all("/memfd:cavmarl (deleted)" in line for line in shared)
    if way == "close":
        pool.close()
        pool.close()
    del pool
    gc.collect()
    assert not alive(pids)
    assert len(os.listdir("/proc/self/fd")) == files


def test_a_stopped_pool_is_closed() -> None:
    pool = Pool(program(2), 60.0, 3)
    pids = [*pool.pids, pool.server_pid]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    pool.close()
    assert gone(pids)


def test_a_program_that_does_not_come_up() -> None:
    gc.collect()
    files = len(os.listdir("/proc/self/fd"))
    with pytest.raises(WorkerFailureError, match="no jobs today") as caught:
        Pool(program(2, fails="no jobs today"), 60.0, 3)
    assert "make_jobs" in caught.value.traceback
    with pytest.raises(WorkerError, match="ended with 3"):
        Pool(program(2, ends=3), 60.0, 3)
    del caught
    gc.collect()
    assert len(os.listdir("/proc/self/fd")) == files


def test_memory_that_cannot_be_had() -> None:
    with pytest.raises(WorkerError, match=r"GB of shared memory .* num_envs"):
        Segment.make(1 << 50)


def test_memory_where_there_is_no_memfd(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delattr(os, "memfd_create")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    segment = Segment.make(5000)
    memory = segment.map()
    assert len(memory) == 5000
    assert not any(tmp_path.iterdir())
    segment.close()
    memory[4999] = 7


@pytest.mark.usefixtures("fresh_processes")
@pytest.mark.parametrize("room", [0, 3, 12, 16, 20])
def test_descriptors_that_cannot_be_had(room: int) -> None:
    gc.collect()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    used = {int(name) for name in os.listdir("/proc/self/fd")}
    free = [number for number in range(len(used) + 100) if number not in used]
    resource.setrlimit(resource.RLIMIT_NOFILE, (free[room], hard))
    try:
        with pytest.raises(WorkerError, match="Too many open files"):
            Pool(program(3), 60.0, 3)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    gc.collect()
    assert len(os.listdir("/proc/self/fd")) == len(used)


LONER = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.path.insert(0, {root!r})
from tests.parallel.test_worker_pool import program
from tests.support.toy_job import ADD, TOIL
from cavmarl.parallel.processes.worker_pool import Pool
pool = Pool(program(2), 60.0, 3)
pool.run(ADD)
print(*pool.pids, pool.server_pid, flush=True)
{then}
"""


@pytest.mark.parametrize("then", ["time.sleep(60)", "pool.run(TOIL, PLACE)"])
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_no_process_outlives_the_pools(how: signal.Signals, then: str, tmp_path: Path) -> None:
    text = LONER.format(root=str(ROOT), then=then.replace("PLACE", repr(str(tmp_path))))
    loner = subprocess.Popen(
        [sys.executable, "-c", text], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert loner.stdout is not None
    if "PLACE" in then:
        with toiling(tmp_path, 2, lambda: loner.send_signal(how), ends=False):
            loner.wait()
    pids = [int(word) for word in loner.stdout.readline().split()]
    assert len(pids) == 3
    loner.send_signal(how)
    loner.wait()
    loner.stdout.close()
    assert gone_soon(pids)


def test_a_pool_without_compiled_loops() -> None:
    text = LONER.format(root=str(ROOT), then="print(pool.run(1, commits=False), pool.deaths)")
    done = subprocess.run(
        [sys.executable, "-c", text],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"[[3.0, {MORE}], [3.0, {MORE}]] []" in done.stdout


def test_a_fork_of_the_pools_process_leaves_the_workers_alone(make: Make) -> None:
    pool = make(workers=1)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(os, "getpid", lambda: 1)
        pool._processes.release()
    pool.run(ADD)
    assert totals(pool) == [[3.0, MORE]]


def test_a_fork_of_the_pools_process_cannot_order_its_workers(make: Make) -> None:
    pool = make(workers=1)
    said = said_in_fork(lambda: pool.run(ADD))
    assert f"process {os.getpid()}" in said
    assert "make the environment here" in said
    pool.run(ADD)
    assert totals(pool) == [[3.0, MORE]]


def test_more_descriptors_than_select_takes(make: Make) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 1300:
        pytest.skip(f"the system allows {hard} open files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (1300, hard))
    taken = [os.open("/dev/null", os.O_RDONLY) for _ in range(1030)]
    try:
        pool = make(workers=2)
        pool.run(ADD)
        os.kill(pool.pids[0], signal.SIGKILL)
        pool.run(ADD)
        assert totals(pool) == [[6.0, 2 * MORE]] * 2
        pids = [*pool.pids, pool.server_pid]
        pool.close()
        assert gone(pids)
    finally:
        for descriptor in taken:
            os.close(descriptor)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_thread_may_start_workers_and_end(make: Make) -> None:
    pools: list[Pool] = []
    thread = threading.Thread(target=lambda: pools.append(make(workers=1)))
    thread.start()
    thread.join()
    while Path(f"/proc/self/task/{thread.native_id}").exists():
        time.sleep(0.001)  # the system ends it a little later
    pools[0].run(ADD)
    assert pools[0].deaths == []
