"""Worlds over worker processes give the results of one process, even if workers die."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import ActionError, CapacityError, ConfigError, make_vec
from cavmarl.config.registry import entries
from cavmarl.core.errors import EpisodeError, WorkerDeathError, WorkerError
from cavmarl.core.processes import start_python
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.processes.worker_processes import WorkerProcesses
from tests.support.vec_runs import STEPS, Make, drive, pool_of, same

pytestmark = pytest.mark.filterwarnings("ignore:workers = 3:RuntimeWarning")


# Small environments come first, because every test run uses the first parameters.
SMALL_FIRST = sorted(entries(), key=lambda env: (env not in ("grid4x4", "merge", "ring"), env))


@pytest.mark.parametrize(("number", "env"), list(enumerate(SMALL_FIRST)))
def test_workers_change_no_result(make: Make, number: int, env: str) -> None:
    """Undivided worlds have 1 to 3 workers, chosen by the index of the environment."""
    wanted = {"num_envs": 5, "max_cycles": 8}
    whole = drive(make(env, **wanted))
    for zones, workers in ((1, 1 + number % 3), (4, 2)):
        assert same(drive(make(env, zones=zones, workers=workers, **wanted)), whole), zones


CLOSED = """
import os, sys
for number in map(int, sys.argv[2]):
    os.close(number)
from cavmarl import make_vec
vec = make_vec("ring", num_envs=2, workers=2, agents=2)
vec.reset(seed=1)
vec.step(vec.suggest_actions())
open(sys.argv[1], "w").write(vec.state_hash(0))
vec.close()
"""


@pytest.mark.parametrize("closed", ["0", "12", "012"])
def test_workers_run_without_standard_descriptors(tmp_path: Path, closed: str) -> None:
    found = tmp_path / "hash"
    process = start_python(["-c", CLOSED, str(found), closed])
    assert process.wait(120.0) == 0
    vec = make_vec("ring", num_envs=2, agents=2)
    drive_once(vec)
    assert found.read_text() == vec.state_hash(0)
    vec.close()


def drive_once(vec: CavVectorEnv) -> None:
    vec.reset(seed=1)
    vec.step(vec.suggest_actions())


def test_autoreset_in_the_next_step_works_while_workers_die(make: Make) -> None:
    wanted = {"num_envs": 3, "agents": 2, "max_cycles": 3, "autoreset_mode": "NextStep"}
    whole = drive(make("merge", **wanted))
    vec = make("merge", workers=2, **wanted)
    pool = pool_of(vec)
    assert same(drive(vec, before=lambda step: os.kill(pool.pids[step % 2], signal.SIGKILL)), whole)
    assert len(pool.deaths) == STEPS


def test_some_worlds_are_reset_in_their_workers(make: Make) -> None:
    chosen = np.array([False, True, False, True, True])
    found = []
    for workers in (0, 2):
        vec = make("merge", num_envs=5, agents=2, workers=workers)
        drive(vec, steps=3)
        observations, infos = vec.reset(options={"reset_mask": chosen})
        found.append([observations, infos["mask"], *(vec.state_hash(w) for w in range(5))])
    assert same(*found)


def test_observations_without_a_copy_share_the_memory_of_the_worlds(make: Make) -> None:
    vec = make("ring", num_envs=2, workers=2, copy=False)
    observations, _ = vec.reset(seed=1)
    assert not observations.flags.writeable
    assert np.shares_memory(observations, vec.worlds.arrays.observations)
    before = observations.copy()
    vec.step(vec.suggest_actions())
    assert not np.array_equal(observations, before)


def test_a_tensor_on_the_shared_memory_has_the_observations_of_each_step(make: Make) -> None:
    torch = pytest.importorskip("torch")
    vec = make("ring", num_envs=2, workers=2)
    tensor = torch.from_numpy(vec.worlds.arrays.observations)
    vec.reset(seed=1)
    for _ in range(3):
        observations, *_ = vec.step(vec.suggest_actions())
        assert np.array_equal(tensor.numpy(), observations)


def test_returned_arrays_outlive_the_workers(make: Make) -> None:
    vec = make("ring", num_envs=2, workers=1, copy=False)
    observations, _ = vec.reset(seed=1)
    vec.close()
    assert observations.any()
    with pytest.raises(EpisodeError, match="after close"):
        vec.reset(seed=1)


@pytest.mark.parametrize("zones", [1, 4])
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_worker_that_dies_between_steps_changes_no_result(
    make: Make, how: signal.Signals, zones: int
) -> None:
    wanted = {"num_envs": 3, "agents": 4, "background": 12, "zones": zones, "max_cycles": 8}
    whole = drive(make("grid4x4", **wanted))
    vec = make("grid4x4", workers=2, **wanted)

    def kill_in_step(step: int) -> None:
        if step % 5 == 2:
            os.kill(pool_of(vec).pids[step % 2], how)

    assert same(drive(vec, before=kill_in_step), whole)
    assert len(pool_of(vec).deaths) == 2
    assert all(death.done_s - death.noticed_s < 5.0 for death in pool_of(vec).deaths)


@pytest.mark.parametrize("env", ["rush", "merge"])
def test_a_worker_is_replaced_before_every_step(make: Make, env: str) -> None:
    wanted = {"num_envs": 2, "agents": 6, "background": 10, "max_cycles": 6}
    whole = drive(make(env, **wanted))
    vec = make(env, workers=2, **wanted)
    found = drive(vec, before=lambda step: os.kill(pool_of(vec).pids[step % 2], signal.SIGKILL))
    assert same(found, whole)
    assert len(pool_of(vec).deaths) == STEPS


def test_a_killed_fork_server_changes_no_result(make: Make) -> None:
    wanted = {"num_envs": 3, "agents": 3, "background": 3}
    whole = drive(make("ring", **wanted))
    vec = make("ring", workers=2, **wanted)

    def kill_in_step(step: int) -> None:
        if step == 4:
            os.kill(pool_of(vec).server_pid, signal.SIGKILL)

    assert same(drive(vec, before=kill_in_step), whole)


def test_an_action_that_is_refused_changes_nothing(make: Make) -> None:
    vec = make("ring", num_envs=3, agents=2, workers=2)
    vec.reset(seed=0)
    before = [vec.state_hash(w) for w in range(3)]
    wrong = np.zeros((3, 2, 2))
    wrong[2, 1, 0] = 3.0
    with pytest.raises(ActionError, match="world 2, car_1"):
        vec.step(wrong)
    assert [vec.state_hash(w) for w in range(3)] == before


def test_errors_equal_those_of_one_process(make: Make) -> None:
    with pytest.raises(CapacityError, match=r"population\.agents"):
        make("ring", num_envs=2, workers=1, agents=4, background=400)
    with pytest.raises(ConfigError, match="backend='local'"):
        _ = make("ring", num_envs=2, workers=1).simulation


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"workers": 3, "num_envs": 2}, ("workers = 3", "at most 2", "more zones")),
        ({"workers": -1}, ("workers = -1", "from 0")),
        ({"workers": 1.5}, ("workers = 1.5", "whole number")),
        ({"workers": True}, ("workers = True", "whole number")),
        ({"workers": 1, "overrides": {"workers.max_retries": -1}}, ("workers.max_retries", "0")),
        ({"workers": 1, "overrides": {"horizon_s": print}}, ("horizon_s",)),
    ],
)
def test_bad_settings_are_refused(arguments: dict[str, Any], words: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError) as caught:
        make_vec("ring", **arguments)
    assert all(word in str(caught.value) for word in words), caught.value


def test_too_little_memory_is_reported() -> None:
    with pytest.raises(WorkerError, match="num_envs"):
        make_vec("rush", num_envs=65_536, workers=2, agents=1000)


def test_more_workers_than_cores_cause_a_warning(make: Make) -> None:
    cores = len(os.sched_getaffinity(0))
    with pytest.warns(RuntimeWarning, match=f"there are {cores} cores"):
        make("ring", num_envs=cores + 1, workers=cores + 1)


def test_pinned_workers_have_one_core_each(make: Make) -> None:
    cores = sorted(os.sched_getaffinity(0))
    vec = make("ring", num_envs=2, workers=2, overrides={"workers.pin": True})
    vec.reset(seed=0)
    wanted = [{cores[k % len(cores)]} for k in range(2)]
    assert [os.sched_getaffinity(pid) for pid in pool_of(vec).pids] == wanted


def test_a_step_that_repeatedly_kills_workers_is_an_error(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    vec = make("ring", num_envs=2, workers=2, overrides={"workers.max_retries": 1})
    vec.reset(seed=0)
    actions = vec.suggest_actions()
    pool = pool_of(vec)
    fork = WorkerProcesses.fork

    def fork_and_kill(self: WorkerProcesses, k: int) -> None:
        fork(self, k)
        os.kill(self.processes[k].pid, signal.SIGKILL)

    monkeypatch.setattr(WorkerProcesses, "fork", fork_and_kill)
    os.kill(pool.pids[1], signal.SIGKILL)
    with pytest.raises(
        WorkerDeathError, match=r"worker 1 \(world 1\).*step.*2 .*SIGKILL"
    ) as caught:
        vec.step(actions)
    assert caught.value.__notes__ == ["in step 1 since the reset"]
    assert pool.pids == []
