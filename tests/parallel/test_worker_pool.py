"""A pool of workers survives killed, stopped and interrupted processes.

The image of a worker is the copy of its state in shared memory. A team is a group of workers that
run one program together and are replaced together.
"""

from __future__ import annotations

import os
import random
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import cavmarl.parallel.processes.process_barrier as barrier
from cavmarl.core.errors import (
    WorkerDeathError,
    WorkerError,
    WorkerFailureError,
)
from cavmarl.parallel.processes import fork_server, worker_loop
from cavmarl.parallel.processes.worker_pool import Pool
from tests.support.pools import (
    MORE,
    Make,
    alive,
    committed_image,
    gone,
    gone_soon,
    in_time,
    program,
    totals,
    toy_pools,
)
from tests.support.toiling import toiling
from tests.support.toy_job import ADD, DIE, DOZE, FAIL, FALL, POINTS, RUN_OUT, TASKS, TOIL, TOTAL


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Enable Ctrl-C, which is disabled if the tests run in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def make() -> Iterator[Make]:
    with toy_pools() as make_pool:
        yield make_pool


def interrupt() -> None:
    signal.raise_signal(signal.SIGINT)


def test_all_workers_run_commands_and_answer(make: Make) -> None:
    pool = make(workers=2)
    for _ in range(3):
        pool.run(ADD)
    assert totals(pool) == [[9.0, 3 * MORE]] * 2
    assert pool.ask(1, TOTAL) == [9.0, 3 * MORE]
    assert pool.deaths == []


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM])
def test_a_worker_that_dies_between_commands_is_replaced(make: Make, how: signal.Signals) -> None:
    pool = make(workers=2)
    pool.run(ADD)
    os.kill(pool.pids[1], how)
    pool.run(ADD)
    assert totals(pool) == [[6.0, 2 * MORE]] * 2
    assert [death.worker for death in pool.deaths] == [1]
    assert how.name in pool.deaths[0].cause


def test_a_worker_that_dies_before_the_first_command_is_replaced(make: Make) -> None:
    pool = make(workers=1)
    os.kill(pool.pids[0], signal.SIGKILL)
    pool.run(ADD)
    assert totals(pool) == [[3.0, MORE]]


def test_workers_that_all_die_during_a_command_are_replaced(make: Make, tmp_path: Path) -> None:
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
def test_a_worker_that_dies_at_a_point_of_a_command_is_replaced(
    make: Make, point: int, tmp_path: Path
) -> None:
    pool = make(workers=2)
    pool.run(ADD)
    (tmp_path / "trap").touch()
    pool.run(FALL, [point, str(tmp_path / "trap")])
    assert totals(pool) == [[6.0, 2 * MORE]] * 2
    assert [death.cause for death in pool.deaths] == ["SIGKILL"]
    pool.run(ADD)
    assert totals(pool) == [[9.0, 3 * MORE]] * 2


def test_a_damaged_image_is_refused(make: Make) -> None:
    pool = make(workers=1)
    pool.run(ADD)
    image = committed_image(pool)
    image[200] ^= 1
    os.kill(pool.pids[0], signal.SIGKILL)
    with pytest.raises(WorkerFailureError, match="is damaged"):
        pool.run(ADD)


def test_a_worker_that_dies_while_another_worker_answers_is_replaced(
    make: Make, tmp_path: Path
) -> None:
    pool = make(workers=2)
    pool.run(ADD)
    first, second = pool.pids
    with toiling(tmp_path, 1, lambda: os.kill(first, signal.SIGKILL)) as place:
        pool.ask(1, TOIL, place)  # only the second worker runs this command, which is not committed
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


def test_a_replaced_team_repeats_a_command_only_in_the_workers_that_received_it(make: Make) -> None:
    pool = make(workers=2, teams=((0, 1),))
    pool.run(ADD)
    os.kill(pool.pids[1], signal.SIGKILL)
    assert pool.ask(0, TOTAL) == [3.0, MORE]
    pool.run(ADD)
    assert totals(pool) == [[6.0, 2 * MORE]] * 2


@pytest.mark.usefixtures("interruptible")
def test_a_team_that_loses_a_worker_during_an_interrupt_is_replaced(
    make: Make, tmp_path: Path
) -> None:
    pool = make(workers=2, teams=((0, 1),))
    pool.run(ADD)
    pids = pool.pids
    with toiling(tmp_path, 2, interrupt, ends=False) as place:
        with pytest.raises(KeyboardInterrupt):
            pool.run(TOIL, place)
        os.kill(pids[1], signal.SIGKILL)
    assert totals(pool) == [[3.0, MORE]] * 2


def test_a_slow_worker_is_not_killed(make: Make) -> None:
    pool = make(workers=1)
    pool.run(TOIL, 1.5)
    assert pool.deaths == []


def test_a_hanging_worker_is_noticed_within_a_second(make: Make) -> None:
    pool = make(workers=2, repeats=0)
    with pytest.raises(WorkerDeathError, match=r"worker 0 \(part 0\).*doze.*asleep for 0\.8 s"):
        pool.run(DOZE, 60.0)


def test_a_worker_that_works_too_long_is_noticed(make: Make) -> None:
    pool = make(workers=1, timeout_s=0.5, repeats=0)
    with pytest.raises(WorkerDeathError, match=r"workers\.timeout_s = 0\.5"):
        pool.run(TOIL, 60.0)


@pytest.mark.parametrize(
    ("task", "payload", "cause"),
    [(DIE, int(signal.SIGKILL), "SIGKILL"), (RUN_OUT, None, "out of memory")],
)
def test_a_task_that_repeatedly_kills_workers_is_an_error(
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


def test_an_exception_has_its_traceback_and_changes_no_state(make: Make) -> None:
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
def test_an_interrupted_command_is_not_committed(make: Make, tmp_path: Path) -> None:
    pool = make(workers=2)
    pool.run(ADD)
    with toiling(tmp_path, 2, interrupt, ends=False) as place, pytest.raises(KeyboardInterrupt):
        pool.run(TOIL, place)
    assert totals(pool) == [[3.0, MORE]] * 2
    assert pool.deaths == []


def test_a_killed_or_stopped_fork_server_is_replaced(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fork_server, "ANSWER_MS", 500)
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


def test_a_fork_server_without_its_pool_ends_silently() -> None:
    """If Ctrl-C ends the pool while the fork server starts, no traceback is printed."""
    pool, server = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    pool.close()
    worker_loop.send_to_pool(server, {"ready": 1})
    assert server.recv(10) == b""  # an empty message makes the server end
    server.close()


def test_the_start_of_workers_is_repeated_if_a_process_is_killed(tmp_path: Path) -> None:
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


def test_the_start_of_workers_is_repeated_if_a_process_is_stopped(tmp_path: Path) -> None:
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


def test_sleeping_workers_receive_every_wake_signal(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(barrier, "SHORT_S", 0.0)
    monkeypatch.setattr(barrier, "LONG_S", 0.0)
    monkeypatch.setattr(barrier, "look", lambda theirs, number, yields: False)
    pool = make(workers=2)
    rng = random.Random(0)
    for _ in range(400):
        time.sleep(rng.uniform(0.0, 1e-4))
        pool.ping()
    assert pool.deaths == []


def test_idle_workers_take_no_processor_time(make: Make) -> None:
    pool = make(workers=2)
    for _ in range(1000):
        pool.ping()
    while any(stat_of(pid)[0] != "S" for pid in pool.pids):
        time.sleep(0.001)  # workers poll before they sleep
    before = [ticks(pid) for pid in pool.pids]
    time.sleep(0.5)
    assert [ticks(pid) for pid in pool.pids] == before


def ticks(pid: int) -> int:
    return int(stat_of(pid)[11]) + int(stat_of(pid)[12])


def stat_of(pid: int) -> list[str]:
    """Return the fields of /proc/PID/stat from the state on."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
