"""A pool frees its processes, memory and descriptors."""

from __future__ import annotations

import gc
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from cavmarl.core.errors import (
    WorkerError,
    WorkerFailureError,
)
from cavmarl.parallel.memory.shared_memory import Segment
from cavmarl.parallel.processes.worker_pool import Pool
from tests.support.forks import said_in_fork
from tests.support.pools import (
    LONER,
    MORE,
    ROOT,
    Make,
    alive,
    gone,
    gone_soon,
    program,
    totals,
    toy_pools,
)
from tests.support.toiling import toiling
from tests.support.toy_job import ADD


@pytest.fixture
def make() -> Iterator[Make]:
    with toy_pools() as make_pool:
        yield make_pool


def test_a_pool_that_a_thread_made_ends_with_the_process_and_not_with_the_thread() -> None:
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
    assert gone_soon(pids)  # including the stopped process


def maps(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/maps").read_text().splitlines()


@pytest.mark.parametrize("way", ["close", "forget"])
def test_no_process_or_descriptor_remains(way: str) -> None:
    Pool(program(1), 60.0, 3).close()  # start the fork server, which outlives each pool
    gc.collect()  # free objects of other tests
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


def test_a_program_that_does_not_start_is_reported() -> None:
    Pool(program(1), 60.0, 3).close()  # start the fork server, which outlives each pool
    gc.collect()
    files = len(os.listdir("/proc/self/fd"))
    with pytest.raises(WorkerFailureError, match="no jobs today") as caught:
        Pool(program(2, fails="no jobs today"), 60.0, 3)
    assert "make_jobs" in caught.value.traceback
    with pytest.raises(WorkerError, match="ended with exit status 3"):
        Pool(program(2, ends=3), 60.0, 3)
    del caught
    gc.collect()
    assert len(os.listdir("/proc/self/fd")) == files


def test_too_little_memory_is_reported() -> None:
    with pytest.raises(WorkerError, match=r"GB of shared memory .* num_envs"):
        Segment.make(1 << 50)


def test_without_memfd_memory_is_a_deleted_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delattr(os, "memfd_create")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    segment = Segment.make(5000)
    memory = segment.map()
    assert len(memory) == 5000
    assert not any(tmp_path.iterdir())
    segment.close()
    memory[4999] = 7


@pytest.mark.usefixtures("fresh_processes")
@pytest.mark.parametrize("room", [0, 3, 12, 16, 19, 20])
def test_too_few_descriptors_are_reported(room: int) -> None:
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


@pytest.mark.parametrize("then", ["time.sleep(60)", "pool.run(TOIL, PLACE)"])
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_no_worker_outlives_the_process_of_its_pool(
    how: signal.Signals, then: str, tmp_path: Path
) -> None:
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


def test_a_pool_works_without_compiled_loops() -> None:
    text = LONER.format(root=str(ROOT), then="print(pool.run(1, commits=False), pool.deaths)")
    done = subprocess.run(
        [sys.executable, "-c", text],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"[[3.0, {MORE}], [3.0, {MORE}]] []" in done.stdout


def test_closing_a_pool_in_a_forked_process_does_not_end_its_workers(make: Make) -> None:
    pool = make(workers=1)
    assert said_in_fork(pool.close) == ""
    pool.run(ADD)
    assert totals(pool) == [[3.0, MORE]]


def test_a_forked_process_cannot_command_the_workers_of_a_pool(make: Make) -> None:
    pool = make(workers=1)
    said = said_in_fork(lambda: pool.run(ADD))
    assert f"process {os.getpid()}" in said
    assert "make the environment here" in said
    pool.run(ADD)
    assert totals(pool) == [[3.0, MORE]]


def test_a_pool_works_with_more_descriptors_than_select_accepts(make: Make) -> None:
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


def test_workers_outlive_the_thread_that_started_them(make: Make) -> None:
    pools: list[Pool] = []
    thread = threading.Thread(target=lambda: pools.append(make(workers=1)))
    thread.start()
    thread.join()
    while Path(f"/proc/self/task/{thread.native_id}").exists():
        time.sleep(0.001)  # the kernel removes the thread a little later
    pools[0].run(ADD)
    assert pools[0].deaths == []
