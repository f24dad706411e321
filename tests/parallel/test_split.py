"""A world that several workers run together equals the undivided world, even if workers die."""

from __future__ import annotations

import os
import random
import signal
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import ConfigError, make_vec
from cavmarl.core.errors import WorkerFailureError
from cavmarl.engine.world_setup import load_world
from cavmarl.parallel.placement.work_shares import make_plans, parts_of
from cavmarl.parallel.workers import pooled_worlds as pooled
from tests.support.actuated import actuated_grid
from tests.support.pools import alive
from tests.support.rerouting import CARS, DEVICE, FLOW, make_map, write_demand
from tests.support.vec_runs import STEPS, Make, drive, pool_of, same

pytestmark = pytest.mark.filterwarnings("ignore:workers = :RuntimeWarning")

SEATS = {"population.mode": "respawn", "action.kind": "discrete"}


@pytest.mark.parametrize(
    ("env", "zones", "workers", "overrides"),
    [  # all pairs of settings
        ("grid4x4", 4, 1, {}),
        ("grid4x4", 9, 2, SEATS),
        ("grid4x4", 4, 3, SEATS),
        ("merge", 9, 1, SEATS),
        ("merge", 4, 2, {}),
        ("merge", 9, 3, {}),
        ("town", 4, 1, SEATS),
        ("town", 4, 2, SEATS),
        ("town", 9, 3, {}),
    ],
)
def test_split_worlds_equal_the_undivided_one(
    make: Make, env: str, zones: int, workers: int, overrides: dict[str, Any]
) -> None:
    wanted = {"agents": 8, "background": 30, "max_cycles": 8, "overrides": overrides}
    whole = drive(make(env, **wanted))
    assert same(drive(make(env, zones=zones, workers=workers, **wanted)), whole)


def test_a_long_run_over_workers_equals_the_undivided_one(make: Make) -> None:
    wanted = {"agents": 3, "background": 60, "max_cycles": 50}
    whole = drive(make("grid4x4", **wanted), steps=80)
    assert same(drive(make("grid4x4", zones=4, workers=2, **wanted), steps=80), whole)


def test_worlds_with_next_step_autoreset_equal_the_undivided_one(make: Make) -> None:
    wanted = {"agents": 4, "background": 10, "max_cycles": 5, "autoreset_mode": "NextStep"}
    whole = drive(make("town", **wanted))
    assert same(drive(make("town", zones=4, workers=2, **wanted)), whole)


def test_worlds_over_three_workers_equal_undivided_worlds(make: Make) -> None:
    wanted = {"num_envs": 2, "agents": 4, "background": 10, "max_cycles": 6}
    whole = drive(make("grid4x4", **wanted))
    vec = make("grid4x4", zones=4, workers=3, **wanted)
    assert same(drive(vec), whole)
    assert np.array_equal(
        vec.reset(options={"reset_mask": np.array([False, True])})[1]["mask"],
        vec.worlds.arrays.mask,
    )


def test_a_world_with_invariant_checks_equals_the_undivided_one(make: Make) -> None:
    wanted = {"agents": 5, "background": 30}
    whole = drive(make("grid4x4", **wanted))
    checked = make(
        "grid4x4", zones=4, workers=2, overrides={"zones.check_invariants": True}, **wanted
    )
    assert same(drive(checked), whole)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("worker", [0, 1])
def test_a_worker_that_dies_between_steps_changes_no_result(
    make: Make, worker: int, how: signal.Signals
) -> None:
    wanted = {"agents": 5, "background": 20, "max_cycles": 8}
    whole = drive(make("grid4x4", **wanted))
    vec = make("grid4x4", zones=4, workers=2, **wanted)

    def kill_in_step(step: int) -> None:
        if step % 5 == 2:
            os.kill(pool_of(vec).pids[worker], how)

    assert same(drive(vec, before=kill_in_step), whole)
    assert [death.worker for death in pool_of(vec).deaths] == [worker] * 2


@pytest.mark.parametrize("env", ["merge", "town"])
def test_workers_that_die_at_any_time_change_no_result(make: Make, env: str) -> None:
    wanted = {"agents": 6, "background": 40, "max_cycles": 18}
    whole = drive(make(env, **wanted), steps=36)
    vec = make(env, zones=4, workers=3, **wanted)
    pids: set[int] = set()
    timers: list[Timer] = []
    rng = random.Random(7)

    def kill_in_step(step: int) -> None:
        pids.update(pool_of(vec).pids)
        if step % 4 == 1:
            pid = pool_of(vec).pids[rng.randrange(3)]
            timers.append(Timer(rng.uniform(0.0, 0.01), os.kill, (pid, signal.SIGKILL)))
            timers[-1].start()
        elif timers:
            timers[-1].join()

    assert same(drive(vec, steps=36, before=kill_in_step), whole)
    assert len(pool_of(vec).deaths) == len(timers)
    left = pool_of(vec).pids
    vec.close()
    assert alive([*pids, *left]) == []


def test_a_killed_fork_server_changes_no_result(make: Make) -> None:
    wanted = {"agents": 3, "background": 20}
    whole = drive(make("grid4x4", **wanted))
    vec = make("grid4x4", zones=4, workers=2, **wanted)

    def kill_in_step(step: int) -> None:
        if step == STEPS // 2:
            os.kill(pool_of(vec).server_pid, signal.SIGKILL)

    assert same(drive(vec, before=kill_in_step), whole)


@pytest.mark.parametrize("phase", ["move", "resolve"])
def test_an_exception_in_one_worker_undoes_the_step_of_all_workers(
    make: Make, phase: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = {"agents": 5, "background": 20}
    whole = drive(make("grid4x4", **wanted))
    monkeypatch.setenv("FAILING_PHASE", phase)
    monkeypatch.setattr(pooled, "PROGRAM", "tests.support.failing_worker")
    vec = make("grid4x4", zones=4, workers=2, **wanted)
    failures: list[WorkerFailureError] = []
    step = vec.step

    def step_again(actions: NDArray[Any]) -> Any:
        try:
            return step(actions)
        except WorkerFailureError as failure:
            failures.append(failure)
        return step(actions)

    monkeypatch.setattr(vec, "step", step_again)
    assert same(drive(vec), whole), "a world has changed"
    (failure,) = failures
    assert (failure.kind, failure.worker) == ("ZeroDivisionError", 1)
    assert "world 0, zone" in str(failure)
    assert failure.text == "of a member"
    trace = failure.traceback
    assert trace.startswith("Traceback (most recent call last)")
    assert "in perform" in trace
    assert "failing_worker.py" in trace
    assert pool_of(vec).deaths == []
    left = [*pool_of(vec).pids, pool_of(vec).server_pid]
    vec.close()
    assert alive(left) == []


def test_actuated_signals_equal_those_of_the_undivided_world(make: Make, tmp_path: Path) -> None:
    wanted = {"agents": 4, "background": 30, "max_cycles": 25}
    net = actuated_grid(tmp_path)
    whole = drive(make(net, **wanted), steps=40)
    assert same(drive(make(net, zones=4, workers=2, **wanted), steps=40), whole)


def test_rerouting_vehicles_take_the_routes_of_the_undivided_world(
    make: Make, tmp_path: Path
) -> None:
    net = make_map(tmp_path)
    files = write_demand(tmp_path, CARS.format(device=DEVICE) + FLOW)
    wanted = {
        "agents": 2,
        "background": 0,
        "max_cycles": 500,
        "overrides": {
            "population.mode": "respawn",
            "traffic.demand": [str(path) for path in files],
            "clock.sim_dt_s": 0.2,
            "clock.ctrl_dt_s": 1.0,
        },
    }
    one = make(net, **wanted)
    whole = drive(one, steps=300)
    vec = make(net, zones=3, workers=2, **wanted)

    def kill_in_step(step: int) -> None:
        if step in (140, 221):
            os.kill(pool_of(vec).pids[step % 2], signal.SIGKILL)

    assert same(drive(vec, steps=300, before=kill_in_step), whole)
    assert len(pool_of(vec).deaths) == 2
    assert one.traffic_stats()["rerouted"] > 0, "no vehicle has taken another route"


def test_more_workers_than_zones_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"workers = 3.*at most 2.*more zones"):
        make_vec("grid4x4", zones=2, workers=3)
    with pytest.raises(ConfigError, match=r"workers = 9.*at most 8.*more worlds"):
        make_vec("grid4x4", num_envs=2, zones=4, workers=9)


@pytest.mark.parametrize(("worlds", "workers"), [(1, 2), (2, 3), (3, 7), (4, 2), (5, 5), (1, 9)])
def test_each_world_and_zone_has_one_worker(worlds: int, workers: int) -> None:
    world = load_world("town", zones=9)
    parts = parts_of(make_plans(world, worlds, workers), world.partition.count)
    assert [w for part in parts for w in range(part.first, part.last)] == list(range(worlds))
    assert sum(len(part.zones) for part in parts) == workers
    assert sum(len(part.names) for part in parts) == workers
    for part in parts:
        assert sorted(zone for zones in part.zones for zone in zones) == list(range(9))
        assert all(part.zones)
