"""Worlds on a Ray cluster of two nodes give the results of one process, even if a node dies."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np
import psutil
import pytest

from cavmarl import CapacityError, ConfigError, parallel_env
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from tests.parallel.test_node_groups import RESTLESS, changing_costs, groups_of, pids_of
from tests.parallel.test_parallel_worlds import drive as drive_view
from tests.parallel.test_parallel_worlds import settings
from tests.support.vec_runs import STEPS, Make, drive, same

ray = pytest.importorskip("ray", reason="needs the extra: ray")

__all__ = ["changing_costs"]

pytestmark = pytest.mark.filterwarnings("ignore")  # Ray warns about its own code

ROOT = Path(__file__).resolve().parents[2]
# Slow tests: `test_node_groups.py` tests the same code in every run, without Ray.
slow = pytest.mark.slow
WANTED = {"num_envs": 5, "agents": 4, "background": 12, "max_cycles": 8}


@pytest.fixture(scope="module")
def two_nodes() -> Iterator[Any]:
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False})
    made.add_node(num_cpus=1)
    ray.init(address=made.address, log_to_driver=False, logging_level="ERROR")
    yield made
    ray.shutdown()
    made.shutdown()


@pytest.fixture
def cluster(two_nodes: Any) -> Any:
    """Return the cluster after closed worlds have released their CPUs."""
    await_true(lambda: ray.available_resources().get("CPU") == 3.0)
    return two_nodes


@pytest.fixture
def undivided_run(make: Make) -> Any:
    return drive(make("grid4x4", **WANTED))


def losses_of(vec: CavVectorEnv) -> list[int]:
    return [group.pool.losses for group in groups_of(vec)]


def nodes_of(pids: list[int]) -> list[int]:
    """Return the pid of the raylet (the process of a Ray node) that started each process."""
    return [psutil.Process(pid).ppid() for pid in pids]


@pytest.mark.parametrize(
    "arguments",
    [
        {"env": "grid4x4", "zones": 4},
        pytest.param({"env": "merge", "autoreset_mode": "NextStep"}, marks=slow),
        pytest.param(
            {"env": "town", "overrides": {"population.mode": "respawn", "action.kind": "discrete"}},
            marks=slow,
        ),
    ],
)
def test_worlds_over_two_ray_nodes_give_the_results_of_one_process(
    make: Make, cluster: Any, arguments: dict[str, Any]
) -> None:
    wanted = WANTED | arguments
    here = drive(make(**wanted))
    vec = make(backend="ray:2", **wanted)
    assert same(drive(vec), here)
    assert same(drive(vec), here)
    assert losses_of(vec) == [0, 0]
    assert len(set(nodes_of(pids_of(vec)))) == 2


def test_some_worlds_are_reset_on_their_ray_nodes(make: Make, cluster: Any) -> None:
    chosen = np.array([False, True, False, True, True])
    found = []
    for arguments in ({}, {"backend": "ray"}):
        vec = make("grid4x4", **WANTED, **arguments)
        drive(vec, steps=3)
        if arguments:
            assert len(pids_of(vec)) == 3
            os.kill(pids_of(vec)[0], signal.SIGKILL)
        observations, infos = vec.reset(options={"reset_mask": chosen})
        found.append([observations, infos["mask"], *(vec.state_hash(w) for w in range(5))])
    assert same(*found)


@pytest.mark.parametrize("how", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=slow)])
def test_a_dead_actor_changes_no_result(
    make: Make, cluster: Any, undivided_run: Any, how: signal.Signals
) -> None:
    vec = make("grid4x4", backend="ray:2", overrides={"workers.timeout_s": 2.0}, **WANTED)
    struck: list[int] = []
    times: list[float] = []

    def kill_in_step(step: int) -> None:
        if step % 6 == 3:
            struck.append(pids_of(vec)[step // 6])
            times.append(time.time())
            os.kill(struck[-1], how)

    assert same(drive(vec, before=kill_in_step), undivided_run)
    assert losses_of(vec) == [1, 1]
    assert (
        psutil.Process(pids_of(vec)[0]).create_time() < times[0]
    )  # the new actor was started in advance
    await_true(lambda: not any(psutil.pid_exists(pid) for pid in struck), for_s=20.0)


@slow
def test_an_actor_that_dies_during_a_step_changes_no_result(
    make: Make, cluster: Any, undivided_run: Any
) -> None:
    vec = make("grid4x4", backend="ray:2", **WANTED)
    timers: list[Timer] = []

    def kill_in_step(step: int) -> None:
        if step in (2, 9):
            pid = pids_of(vec)[step % 2]
            timers.append(Timer(0.001 * step, os.kill, (pid, signal.SIGKILL)))
            timers[-1].start()

    assert same(drive(vec, before=kill_in_step), undivided_run)
    for timer in timers:
        timer.join()
    drive(vec, steps=1)
    assert losses_of(vec) == [1, 1]


@pytest.mark.parametrize(
    "more", [{"backend": "ray:1"}, pytest.param({"backend": "ray"}, marks=slow)]
)
def test_the_pettingzoo_environment_on_ray_gives_the_results_of_one_process(
    cluster: Any, more: dict[str, Any]
) -> None:
    undivided_run = drive_view(parallel_env("grid4x4", **settings("open", "dict")))
    env = parallel_env("grid4x4", **settings("open", "dict"), **more)
    pools = [group.pool for group in getattr(env.worlds, "groups", [env.worlds])]

    def kill(step: int) -> None:
        if step % 9 == 4:
            os.kill(pools[0].pids[0], signal.SIGKILL)

    assert drive_view(env, before=kill) == undivided_run
    assert pools[0].losses > 0
    with pytest.raises(ConfigError, match="backend='local'"):
        _ = env.simulation
    pids = pools[0].pids
    env.close()
    await_true(lambda: not any(psutil.pid_exists(pid) for pid in pids))


@slow
def test_worlds_that_move_between_ray_nodes_give_the_same_results(
    make: Make, cluster: Any, changing_costs: list[int]
) -> None:
    """Worlds move before an actor dies, so that it no longer runs its first worlds."""
    undivided_run = drive(make("grid4x4", **WANTED), steps=16)
    vec = make("grid4x4", backend="ray:3", overrides=RESTLESS, **WANTED)
    vec.reset(seed=0)
    assert len(set(nodes_of(pids_of(vec)))) == 2

    def kill_in_step(step: int) -> None:
        if step in (5, 11):
            os.kill(pids_of(vec)[step % 3], signal.SIGKILL)

    assert same(drive(vec, steps=16, before=kill_in_step), undivided_run)
    assert sum(losses_of(vec)) == 2
    assert sum(changing_costs) > 0


def test_ray_actors_run_the_zones_of_one_world(cluster: Any) -> None:
    undivided_run = drive_view(parallel_env("grid4x4", **settings("open", "dict")))
    env = parallel_env("grid4x4", backend="ray:2", **settings("open", "dict"))
    assert isinstance(env.worlds, NodeWorlds)
    assert drive_view(env) == undivided_run
    env.close()


def test_errors_equal_those_of_one_process(make: Make, cluster: Any) -> None:
    with pytest.raises(CapacityError, match=r"population\.agents"):
        make("ring", num_envs=2, backend="ray:1", agents=4, background=400)
    with pytest.raises(ConfigError, match=r"backend = 'ray:4'.*3 free CPUs on 2 nodes"):
        make("ring", num_envs=4, backend="ray:4")
    vec = make("ring", num_envs=2, backend="ray:1")
    with pytest.raises(ConfigError, match="backend='local'"):
        _ = vec.simulation


def test_closing_worlds_ends_their_actors_but_not_the_cluster(make: Make, cluster: Any) -> None:
    vec = make("ring", num_envs=2, backend="ray:2")
    vec.reset(seed=0)
    pids = pids_of(vec)
    vec.close()
    await_true(lambda: not any(psutil.pid_exists(pid) for pid in pids))
    await_true(lambda: ray.available_resources().get("CPU") == 3.0)
    assert ray.is_initialized()


def test_a_dead_node_changes_no_result(make: Make, cluster: Any, undivided_run: Any) -> None:
    """All processes of the node die at once, and its worlds resume on the other node."""
    node = cluster.add_node(num_cpus=1)
    vec = make("grid4x4", backend="ray:4", **WANTED)
    raylet = node.all_processes["raylet"][0].process.pid
    vec.reset(seed=0)
    pids = pids_of(vec)
    victim = nodes_of(pids).index(raylet)

    def kill_in_step(step: int) -> None:
        if step == STEPS // 2:
            cluster.remove_node(node, allow_graceful=False)
            await_true(
                lambda: not psutil.pid_exists(pids[victim])
            )  # the actor ends with the raylet that started it

    assert same(drive(vec, before=kill_in_step), undivided_run)
    assert losses_of(vec)[victim] == 1
    assert raylet not in nodes_of(pids_of(vec))


KILLED = """
import os, signal, sys
import ray
from cavmarl import make_vec

if __name__ == "__main__":
    vec = make_vec("ring", num_envs=2, backend="ray:2")
    vec.reset(seed=0)
    print("pids", *(group.pool.pids[0] for group in vec.worlds.groups), flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_program_leaves_nothing_behind(cluster: Any) -> None:
    done = subprocess.run(
        [sys.executable, "-c", KILLED],
        cwd=ROOT,
        env={**os.environ, "RAY_ADDRESS": cluster.address},
        capture_output=True,
        text=True,
        timeout=120,
    )
    said = re.search(r"^pids (\d+) (\d+)$", done.stdout, re.MULTILINE)  # Ray prints other lines
    assert said, done.stderr
    pids = [int(word) for word in said.groups()]
    await_true(lambda: not any(psutil.pid_exists(pid) for pid in pids))
    await_true(lambda: ray.available_resources().get("CPU") == 3.0)


def await_true(holds: Callable[[], bool], for_s: float = 10.0) -> None:
    until_s = time.monotonic() + for_s
    while not holds():
        assert time.monotonic() < until_s
        time.sleep(0.1)
