"""Copies of SUMO logs in memory that outlives a process; each update copies only new entries."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl.core.errors import SumoError, WorkerError
from cavmarl.parallel.memory.shared_memory import Segment
from cavmarl.parallel.state.sumo_log import FIRST_LOG_BYTES, KeptLog
from cavmarl.traffic.sumo.sumo_history import MOVED, ToldLog


def moved_in_tick(number: int, vehicles: int) -> np.ndarray:
    """Return the MOVED records of a tick, with values that depend on `number`."""
    moved = np.zeros(vehicles, dtype=MOVED)
    moved["id"] = np.arange(vehicles)
    moved["x"], moved["y"], moved["angle"] = 0.1 * number, -number, number / 7.0
    moved["edge"], moved["kind"] = number, vehicles
    return moved


def log_of(ticks: int, most_bytes: int = 1 << 20, first: int = 0) -> ToldLog:
    log = ToldLog(most_bytes)
    for number in range(ticks):
        log.note(moved_in_tick(first + number, number % 5))
    return log


def bytes_of(log: ToldLog, ticks: int) -> list[bytes]:
    return [moved.tobytes() for moved in log.ticks(ticks)]


def test_a_log_returns_the_noted_ticks() -> None:
    log = log_of(500)
    assert bytes_of(log, 500) == [moved_in_tick(n, n % 5).tobytes() for n in range(500)]
    assert bytes_of(log, 3) == bytes_of(log, 500)[:3]
    assert bytes_of(log, 0) == []


def test_a_restarted_log_does_not_change_returned_ticks() -> None:
    log = log_of(40)
    before = log.ticks(40)
    log.begin()
    for number in range(40):
        log.note(moved_in_tick(100 + number, 4))
    assert [moved.tobytes() for moved in before] == [
        moved_in_tick(n, n % 5).tobytes() for n in range(40)
    ]


def test_more_ticks_than_were_logged_are_refused() -> None:
    with pytest.raises(SumoError, match=r"the log of a SUMO process has 3 of 4 ticks.*reset"):
        log_of(3).ticks(4)


@pytest.mark.parametrize("most_bytes", [0, 100, 4000])
def test_a_log_that_is_too_long_is_discarded_until_its_restart(most_bytes: int) -> None:
    log = log_of(200, most_bytes)
    assert log.words.nbytes < 100
    with pytest.raises(SumoError, match=r"exceeds .* MiB.*sumo\.replay_mib"):
        log.ticks(1)
    log.begin()
    assert bytes_of(log, 0) == []


def test_a_copy_equals_the_log_after_any_number_of_updates() -> None:
    segment = Segment.make(FIRST_LOG_BYTES)
    kept, log = KeptLog(segment), log_of(10)
    for number in range(200):
        log.note(moved_in_tick(number, 7))
        if number % 13 == 0:
            kept.write(log)
            other = ToldLog(1 << 20)
            other.take_up(KeptLog(Segment(segment.fd, 0)).read())
            assert other.words.tobytes() == log.words.tobytes()
    other.note(moved_in_tick(3, 2))  # the other log gets its own entry
    assert other.words.size != kept.read().size
    segment.close()


def test_a_copy_of_another_episode_is_rewritten() -> None:
    segment = Segment.make(FIRST_LOG_BYTES)
    kept, log = KeptLog(segment), log_of(50)
    kept.write(log)
    log.begin()
    for number in range(60):  # the log is now longer than its copy and has other content
        log.note(moved_in_tick(1000 + number, number % 5))
    kept.write(log)
    assert kept.read().tobytes() == log.words.tobytes()
    KeptLog(Segment(segment.fd, 0)).write(log_of(55, first=7))  # as another process would do
    assert kept.read().tobytes() == log_of(55, first=7).words.tobytes()
    segment.close()


def test_a_copy_that_was_never_written_is_refused() -> None:
    segment = Segment.make(FIRST_LOG_BYTES)
    with pytest.raises(WorkerError, match="is damaged"):
        KeptLog(segment).read()
    segment.close()
