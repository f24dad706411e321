"""Worlds that move from host to host while they are stepped: results stay the same."""

from __future__ import annotations

import os
import random
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import ConfigError, make_vec
from cavmarl.core.errors import WorkerError, WorkerFailureError
from cavmarl.env.vector import CavVectorEnv
from cavmarl.evaluate.provenance.manifest import MANIFEST_FILE
from cavmarl.evaluate.provenance.training_record import begin_training, end_training
from cavmarl.parallel.checkpoint.world_states import WorldMove, moves_of
from cavmarl.parallel.hosts.host_pool import HostPool
from cavmarl.parallel.hosts.remote_worlds import RemoteWorlds
from cavmarl.parallel.tasks import Task
from tests.parallel.test_moving import RESTLESS, STACKED, uneven
from tests.support.pools import strike_soon
from tests.support.rerouting import CARS, DEVICE, FLOW, make_map, write_demand
from tests.support.vec_runs import Make, drive, same
from tests.support.world_hosts import WorldHosts

__all__ = ["uneven"]

WANTED = {"num_envs": 5, "agents": 4, "background": 12, "max_cycles": 8}


@pytest.fixture(autouse=True)
def without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cavmarl.parallel.hosts.remote_worlds.RayActors", WorldHosts)


def remote(vec: CavVectorEnv) -> RemoteWorlds:
    assert isinstance(vec.worlds, RemoteWorlds)
    return vec.worlds


def test_what_becomes_of_the_worlds_of_each_host() -> None:
    assert moves_of([0, 3, 6], [0, 5, 6]) == [WorldMove(0, 3, 0, 2), WorldMove(2, 3, 0, 0)]
    assert moves_of([0, 3, 6], [0, 1, 6]) == [WorldMove(0, 1, 0, 0), WorldMove(0, 3, 2, 2)]
    assert moves_of([0, 1, 2, 9], [0, 3, 7, 9]) == [
        WorldMove(0, 1, 0, 2), WorldMove(0, 0, 4, 4), WorldMove(5, 7, 0, 0)
    ]  # fmt: skip


@pytest.mark.parametrize(
    "arguments",
    [
        {"env": "grid4x4", "zones": 4, "backend": "ray:3"},
        {"env": "merge", "autoreset_mode": "NextStep", "backend": "ray:2"},
        {"env": "town", "overrides": STACKED, "backend": "ray:2"},
    ],
)
def test_worlds_that_move_are_the_same(
    make: Make, uneven: list[int], arguments: dict[str, Any]
) -> None:
    wanted = WANTED | arguments
    whole = drive(make(**{**wanted, "backend": "local"}), steps=20)
    wanted["overrides"] = {**wanted.get("overrides", {}), **RESTLESS}
    vec = make(**wanted)
    assert same(drive(vec, steps=20), whole)
    assert sum(uneven) > 0
    assert remote(vec).pool.deaths == []
    mover = remote(vec).mover
    assert mover is not None
    assert mover.moves == sum(uneven)


def test_vehicles_that_find_their_own_way_keep_it(
    make: Make, uneven: list[int], tmp_path: Path
) -> None:
    files = write_demand(tmp_path, CARS.format(device=DEVICE) + FLOW)
    overrides = {
        "traffic.demand": [str(path) for path in files],
        "clock.sim_dt_s": 0.2,
        "clock.ctrl_dt_s": 1.0,
        "horizon_s": 600.0,
        "population.mode": "respawn",
        **RESTLESS,
        "workers.balance_steps": 40,
    }
    wanted = {"num_envs": 4, "agents": 1, "background": 0, "overrides": overrides}
    net = str(make_map(tmp_path))
    whole = make(net, **wanted)
    before = drive(whole, steps=400)
    assert whole.traffic_stats()["rerouted"] > 0
    assert same(drive(make(net, backend="ray:2", **wanted), steps=400), before)
    assert sum(uneven) > 0


def test_chosen_worlds_begin_anew_wherever_they_are(make: Make, uneven: list[int]) -> None:
    chosen = np.array([False, True, False, True, True])
    found = []
    for more in ({}, {"backend": "ray:2"}):
        vec = make("merge", num_envs=5, agents=2, overrides=RESTLESS, **more)
        drive(vec, steps=9)
        observations, infos = vec.reset(options={"reset_mask": chosen})
        vec.step(vec.suggest_actions())
        found.append([observations, infos["mask"], *(vec.state_hash(w) for w in range(-5, 0))])
    assert same(*found)
    assert sum(uneven) > 0


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_hosts_that_die_while_worlds_move(
    make: Make, uneven: list[int], monkeypatch: pytest.MonkeyPatch, how: signal.Signals
) -> None:
    """Before the order is sent, while it is carried out, or when it is through."""
    whole = drive(make("grid4x4", **WANTED), steps=20)
    vec = make("grid4x4", backend="ray:2", overrides=RESTLESS, **WANTED)
    rng = random.Random(2)
    run, timers = HostPool.run, []

    def strike(self: HostPool, task: int, *args: Any, **more: Any) -> Any:
        if task in (Task.PACK, Task.UNPACK) and len(timers) < 4:
            self.await_spare()
            pid = self.pids[rng.randrange(2)]
            timers.append(strike_soon(pid, rng.uniform(0.0, 0.01), how))
        return run(self, task, *args, **more)

    monkeypatch.setattr(HostPool, "run", strike)
    assert same(drive(vec, steps=20, before=lambda _: [t.join() for t in timers]), whole)
    assert len(remote(vec).pool.deaths) >= 3
    assert sum(uneven) > 0


def test_who_dies_later_comes_back_with_what_it_had_last(make: Make, uneven: list[int]) -> None:
    whole = drive(make("grid4x4", **WANTED), steps=24)
    vec = make("grid4x4", backend="ray:2", overrides=RESTLESS, **WANTED)

    def strike(step: int) -> None:
        if step % 7 == 5:
            remote(vec).pool.await_spare()
            os.kill(remote(vec).pool.pids[step % 2], signal.SIGKILL)

    assert same(drive(vec, steps=24, before=strike), whole)
    assert len(remote(vec).pool.deaths) == 3
    assert sum(uneven) > 0


@pytest.mark.parametrize("is_through", [False, True])
def test_a_move_that_is_interrupted_leaves_every_world_somewhere(
    make: Make, uneven: list[int], monkeypatch: pytest.MonkeyPatch, is_through: bool
) -> None:
    whole = drive(make("ring", **WANTED))
    vec = make("ring", backend="ray:2", overrides=RESTLESS, **WANTED)
    run, failed = HostPool.run, []

    def interrupt(self: HostPool, task: int, *args: Any, **more: Any) -> Any:
        if task != Task.UNPACK or failed:
            return run(self, task, *args, **more)
        failed.append(task)
        if is_through:
            run(self, task, *args, **more)
        raise KeyboardInterrupt

    monkeypatch.setattr(HostPool, "run", interrupt)
    step = type(vec).step

    def again(self: Any, actions: Any) -> Any:
        try:
            return step(self, actions)
        except KeyboardInterrupt:
            return step(self, actions)

    monkeypatch.setattr(type(vec), "step", again)
    assert same(drive(vec), whole)
    assert failed
    assert sum(uneven) > 0


def test_a_case_that_is_not_what_was_packed(
    make: Make, uneven: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    vec = make("ring", backend="ray:2", overrides=RESTLESS, **WANTED)
    unpack = RemoteWorlds._unpack

    def spoil(self: RemoteWorlds, bounds: Any) -> None:
        for one in self._leaving.values():
            one[one.size // 2] ^= 1
        unpack(self, bounds)

    monkeypatch.setattr(RemoteWorlds, "_unpack", spoil)
    with pytest.raises((WorkerError, WorkerFailureError), match="is not what it wrote"):
        drive(vec)
    monkeypatch.undo()
    assert same(drive(vec), drive(make("ring", **WANTED)))


def test_the_plan_is_that_of_the_hosts_and_on_record(make: Make, tmp_path: Path) -> None:
    overrides = {"workers.balance_steps": 3, "workers.imbalance_tolerance": 0.0}
    vec = make("ring", backend="ray:2", overrides=overrides, **WANTED)
    begin_training(tmp_path, "test", {"seed": 1}, remote(vec).world, vec.plans)
    drive(vec)
    end_training(tmp_path, [], vec.plans)
    (plan,) = vec.plans
    assert plan.problem.cost_source == "measured"
    assert all(0.0 < shard.cost_s < 1.0 for shard in plan.problem.shards)
    assert "measured" in (tmp_path / MANIFEST_FILE).read_text(encoding="utf-8")


def test_only_this_machine_is_watched() -> None:
    with pytest.raises(
        ConfigError, match=r"workers\.monitor_cpu = True, backend = 'ray'.*use backend"
    ):
        make_vec("ring", backend="ray:1", overrides={"workers.monitor_cpu": True})
