"""Checkpoint logs by themselves, and in workers that die while the log restarts."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from cavmarl.engine.world_setup import load_world
from cavmarl.parallel.state.checkpoint_log import STEPS, CheckpointLog, make_segments
from cavmarl.shards.shard import Commands
from tests.support.vec_runs import Make, drive, pool_of, same

pytestmark = pytest.mark.filterwarnings("ignore:workers = :RuntimeWarning")

WHOLE = {"num_envs": 2}
SPLIT = {"zones": 4}


@pytest.mark.parametrize("kind", [WHOLE, SPLIT])
@pytest.mark.parametrize("worker", [0, 1])
def test_a_worker_that_dies_when_the_log_is_full_changes_no_result(
    make: Make, kind: dict[str, Any], worker: int
) -> None:
    wanted = {**kind, "agents": 4, "background": 20, "max_cycles": 60}
    steps = 2 * STEPS + 4
    whole = drive(make("grid4x4", **wanted), steps=steps)
    vec = make("grid4x4", workers=2, **wanted)
    at = {STEPS - 1, STEPS, STEPS + 1, STEPS + 2, 2 * STEPS, 2 * STEPS + 1}

    def kill_in_step(step: int) -> None:
        if step in at:
            os.kill(pool_of(vec).pids[worker], signal.SIGKILL)

    assert same(drive(vec, steps=steps, before=kill_in_step), whole)
    assert [death.worker for death in pool_of(vec).deaths] == [worker] * len(at)


@pytest.mark.parametrize("kind", [WHOLE, SPLIT])
def test_resets_when_the_log_is_full_change_no_result(make: Make, kind: dict[str, Any]) -> None:
    wanted = {**kind, "agents": 4, "background": 20, "max_cycles": 60}

    def run(workers: int) -> list[Any]:
        vec = make("grid4x4", workers=workers, **wanted)

        def before(step: int) -> None:
            if step in (STEPS, STEPS + 3):
                chosen = np.arange(vec.num_envs) == 0
                vec.reset(options={"reset_mask": chosen})
            if workers and step in (STEPS, STEPS + 1, STEPS + 3):
                os.kill(pool_of(vec).pids[0], signal.SIGKILL)

        return drive(vec, steps=STEPS + 6, before=before)

    assert same(run(2), run(0))


@pytest.fixture
def checkpoint_log() -> Iterator[CheckpointLog]:
    config = load_world("merge").config
    segments = make_segments(config, 1, 0)
    yield CheckpointLog(config, 1, 0, [segment.fd for segment in segments])
    for segment in segments:
        segment.close()


def commands_like(entry: Commands, value: int) -> Commands:
    return Commands(
        np.full_like(entry.controls, value),
        np.full_like(entry.meta_actions, value),
        np.full_like(entry.declared, value),
        np.full_like(entry.inserted, value),
        np.full_like(entry.external, value),
        np.full_like(entry.overridden, value),
        np.full_like(entry.lane_changes, value),
        np.full_like(entry.signal_choices, value),
    )


def noted_values(checkpoint_log: CheckpointLog) -> list[float]:
    return [float(entry.controls.flat[0]) for entry in checkpoint_log.steps()]


def state_of(checkpoint_log: CheckpointLog) -> list[float]:
    (found,) = checkpoint_log.state([np.zeros(3)])
    return [float(value) for value in found]


def test_a_committed_state_stays_until_the_next_commit(checkpoint_log: CheckpointLog) -> None:
    checkpoint_log.prepare([np.full(3, 1.0)])
    checkpoint_log.begin()
    for value in range(STEPS):
        checkpoint_log.note(commands_like(checkpoint_log.entries[0], value))
    assert checkpoint_log.is_full
    committed = checkpoint_log.place.copy()
    checkpoint_log.prepare([np.full(3, 2.0)])
    assert checkpoint_log.is_prepared
    assert (state_of(checkpoint_log), len(checkpoint_log)) == ([1.0] * 3, STEPS), (
        "the log has restarted before begin()"
    )
    checkpoint_log.begin()
    checkpoint_log.note(commands_like(checkpoint_log.entries[0], 99))
    assert (state_of(checkpoint_log), noted_values(checkpoint_log)) == ([2.0] * 3, [99.0])
    checkpoint_log.go_to(committed)  # as if the pool died before it committed the new log
    assert (state_of(checkpoint_log), noted_values(checkpoint_log)) == (
        [1.0] * 3,
        [float(k) for k in range(STEPS)],
    )
    assert not checkpoint_log.is_prepared
