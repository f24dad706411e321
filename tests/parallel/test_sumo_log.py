"""What a SUMO was told, kept in memory that outlives a process: only what is new is copied."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl.core.errors import SumoError, WorkerError
from cavmarl.parallel.checkpoint.sumo_log import FIRST_LOG_BYTES, KeptLog
from cavmarl.parallel.processes.shared_memory import Segment
from cavmarl.traffic.sumo.sumo_history import MOVED, ToldLog


def told(number: int, vehicles: int) -> np.ndarray:
    """MOVED of a tick in which every value tells which one it is."""
    moved = np.zeros(vehicles, dtype=MOVED)
    moved["id"] = np.arange(vehicles)
    moved["x"], moved["y"], moved["angle"] = 0.1 * number, -number, number / 7.0
    moved["edge"], moved["kind"] = number, vehicles
    return moved


def log_of(ticks: int, most_bytes: int = 1 << 20, first: int = 0) -> ToldLog:
    log = ToldLog(most_bytes)
    for number in range(ticks):
        log.note(told(first + number, number % 5))
    return log


def bytes_of(log: ToldLog, ticks: int) -> list[bytes]:
    return [moved.tobytes() for moved in log.ticks(ticks)]


def test_a_log_says_what_was_told() -> None:
    log = log_of(500)
    assert bytes_of(log, 500) == [told(n, n % 5).tobytes() for n in range(500)]
    assert bytes_of(log, 3) == bytes_of(log, 500)[:3]
    assert bytes_of(log, 0) == []


def test_a_log_that_is_begun_anew_leaves_what_it_gave() -> None:
    log = log_of(40)
    before = log.ticks(40)
    log.begin()
    for number in range(40):
        log.note(told(100 + number, 4))
    assert [moved.tobytes() for moved in before] == [told(n, n % 5).tobytes() for n in range(40)]


def test_more_ticks_than_were_noted_are_refused() -> None:
    with pytest.raises(SumoError, match=r"of 4 ticks of a SUMO 3 are on record.*reset"):
        log_of(3).ticks(4)


@pytest.mark.parametrize("most_bytes", [0, 100, 4000])
def test_a_log_that_would_be_too_long_is_given_up_until_it_is_begun_anew(most_bytes: int) -> None:
    log = log_of(200, most_bytes)
    assert log.words.nbytes < 100
    with pytest.raises(SumoError, match=r"exceeds .* MiB.*sumo\.replay_mib"):
        log.ticks(1)
    log.begin()
    assert bytes_of(log, 0) == []


def test_a_copy_is_the_log_however_often_it_is_brought_up_to_date() -> None:
    segment = Segment.make(FIRST_LOG_BYTES)
    kept, log = KeptLog(segment), log_of(10)
    for number in range(200):
        log.note(told(number, 7))
        if number % 13 == 0:
            kept.write(log)
            other = ToldLog(1 << 20)
            other.take_up(KeptLog(Segment(segment.fd, 0)).read())
            assert other.words.tobytes() == log.words.tobytes()
    other.note(told(3, 2))  # which is its own
    assert other.words.size != kept.read().size
    segment.close()


def test_a_copy_of_another_episode_is_written_anew() -> None:
    segment = Segment.make(FIRST_LOG_BYTES)
    kept, log = KeptLog(segment), log_of(50)
    kept.write(log)
    log.begin()
    for number in range(60):  # longer than what is there, and not the same
        log.note(told(1000 + number, number % 5))
    kept.write(log)
    assert kept.read().tobytes() == log.words.tobytes()
    KeptLog(Segment(segment.fd, 0)).write(log_of(55, first=7))  # another process's
    assert kept.read().tobytes() == log_of(55, first=7).words.tobytes()
    segment.close()


def test_what_nobody_has_written_is_refused() -> None:
    segment = Segment.make(FIRST_LOG_BYTES)
    with pytest.raises(WorkerError, match="not what was written"):
        KeptLog(segment).read()
    segment.close()
