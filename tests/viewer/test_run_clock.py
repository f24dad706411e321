"""Times at which steps are due, with a clock that the test sets."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from cavmarl.viewer import run_clock
from cavmarl.viewer.page_requests import PageRequest
from cavmarl.viewer.run_clock import RunClock


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Return a clock whose time is `now.s`, at first 100 s."""
    found = SimpleNamespace(s=100.0)
    monkeypatch.setattr(run_clock, "time", SimpleNamespace(monotonic=lambda: found.s))
    return found


def steps_due(clock: RunClock, now_s: float, step_s: float) -> int:
    """Take all steps that are due, and count them."""
    count = 0
    while clock.wait_s(now_s) == 0.0 and count < 100:
        clock.tick(now_s, step_s)
        count += 1
    return count


@pytest.mark.parametrize(("pace", "wait_s"), [(2.0, 0.05), (0.5, 0.2), (0.1, 0.25)])
def test_the_next_step_is_due_after_its_duration_divided_by_the_pace(
    now: SimpleNamespace, pace: float, wait_s: float
) -> None:
    clock = RunClock(pace)
    assert clock.wait_s(now.s) == 0.0
    clock.tick(now.s, 0.1)
    assert clock.wait_s(now.s) == pytest.approx(wait_s)
    assert clock.wait_s(now.s + 2.0) == 0.0


def test_pace_0_never_waits(now: SimpleNamespace) -> None:
    assert steps_due(RunClock(0.0), now.s, 0.1) == 100


def test_a_late_clock_catches_up_at_most_half_a_second(now: SimpleNamespace) -> None:
    clock = RunClock(1.0)
    now.s += 3.0
    # The steps that were due at 102.5, 102.7 and 102.9 s are taken at once.
    assert steps_due(clock, now.s, 0.2) == 3
    assert clock.wait_s(now.s) == pytest.approx(0.1)


def test_a_paused_world_takes_at_most_ten_requested_steps(now: SimpleNamespace) -> None:
    clock = RunClock(1.0)
    assert clock.handle(PageRequest("pause"))
    assert steps_due(clock, now.s, 0.1) == 0
    for count, due in ((1, 1), (15, 10), (2, 2)):
        for _ in range(count):
            assert clock.handle(PageRequest("step"))
        assert steps_due(clock, now.s, 0.1) == due
        assert clock.wait_s(now.s) == 0.25
    now.s += 60.0
    assert clock.handle(PageRequest("play"))
    assert steps_due(clock, now.s, 0.1) == 1, "the clock caught up on the time of the pause"


def test_a_requested_step_pauses_a_running_world(now: SimpleNamespace) -> None:
    clock = RunClock(1.0)
    clock.handle(PageRequest("step"))
    assert clock.is_paused
    assert steps_due(clock, now.s, 0.1) == 1


def test_a_new_pace_applies_at_once(now: SimpleNamespace) -> None:
    clock = RunClock(0.1)
    clock.tick(now.s, 1.0)  # due in 10 s
    assert clock.handle(PageRequest("pace", 4.0))
    assert clock.wait_s(now.s) == 0.0
    clock.tick(now.s, 0.4)
    assert clock.wait_s(now.s) == pytest.approx(0.1)
    assert not clock.handle(PageRequest("watch", 4.0))
    assert clock.pace == 4.0
