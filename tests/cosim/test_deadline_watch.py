"""Deadlines of steps in real time: missed deadlines are counted by phase."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from cavmarl.core.errors import ConfigError
from cavmarl.cosim.deadline_watch import BEHIND, WORLD, DeadlineWatch
from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.cosim.followers.follower_client import Follower
from cavmarl.cosim.time_master import RealTime
from cavmarl.engine.step_trace import QUEUE, STACK
from tests.cosim.conftest import hashes, make_env, steer

Start = Callable[[Callable[[], Any]], threading.Thread]


class Clock:
    """A wall clock that a test sets."""

    now_s = 100.0

    def now(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


def test_a_miss_counts_for_the_phase_in_which_the_deadline_passes() -> None:
    clock = Clock()
    watch = DeadlineWatch(0.05, clock.now)
    for spent in ((0.02, 0.02, 0.0), (0.06, 0.0, 0.0), (0.03, 0.04, 0.5), (0.03, 0.01, 0.02)):
        watch.begin(clock.now_s)
        for seconds, phase in zip(spent, (STACK, QUEUE, ""), strict=True):
            clock.now_s += seconds
            if phase:
                watch.note(phase)
        watch.end()
    assert watch.misses == {WORLD: 1, STACK: 1, QUEUE: 1}
    assert watch.report() == {
        "deadline_s": 0.05,
        "steps": 4,
        "missed": 3,
        "missed_in": {WORLD: 1, STACK: 1, QUEUE: 1},
        "worst_wall_s": pytest.approx(0.52),
    }


def test_a_step_that_begins_late_counts_as_behind() -> None:
    clock = Clock()
    pacer = RealTime(1.0, clock.now, clock.sleep, deadline_s=0.05)
    assert pacer.watch is not None
    pacer.wait(0.0)
    clock.now_s += 0.2  # the first step takes four times its deadline
    for step in (1, 2, 3, 4, 5):
        pacer.wait(0.05 * step)
    pacer.watch.end()
    # Steps 1 and 2 begin 0.15 s and 0.1 s late. Step 3 begins exactly at its deadline, so it counts
    # as late but not as a miss.
    assert pacer.watch.misses == {WORLD: 1, BEHIND: 2}
    assert pacer.lateness.late == 3
    assert pacer.watch.steps == 6


@pytest.mark.parametrize("deadline_s", [0.0, -1.0, float("inf"), float("nan")])
def test_an_impossible_deadline_is_refused(deadline_s: float) -> None:
    with pytest.raises(ConfigError, match="deadline_s"):
        RealTime(1.0, deadline_s=deadline_s)


def test_a_slow_follower_misses_deadlines_and_changes_no_state(
    tmp_path: Path, start: Start
) -> None:
    def slowly(address: Path, rest_s: float) -> None:
        with Follower(address, ["car_0"]) as follower:
            for view in follower:
                if view.snapshot.frame == 3:
                    time.sleep(rest_s)
                follower.answer(steer(view))

    found = []
    for name, rest_s in (("a", 0.0), ("b", 0.3)):
        address = tmp_path / name
        pacer = RealTime(1.0, deadline_s=0.2)
        with closing(make_env()) as env, FollowedWorld(env, address, pacer=pacer) as world:
            start(lambda address=address, rest_s=rest_s: slowly(address, rest_s))  # type: ignore[misc]
            world.wait_for(1, 10.0)
            world.reset(seed=1)
            found.append(hashes(world, 6))
        assert pacer.watch is not None
        if rest_s:
            assert pacer.watch.misses[STACK] >= 1
            assert pacer.watch.worst_wall_s > 0.05
    assert found[0] == found[1]
