"""Worlds and zones that move to other workers between steps: the results stay the same."""

from __future__ import annotations

import logging
import os
import random
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import ConfigError, make_vec
from cavmarl.balance.balance_plan import replan
from cavmarl.balance.load_score import Candidate, Utilisation
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.balance.plan_file import plan_from_dict
from cavmarl.config.registry import entries
from cavmarl.core.errors import NoAdmissibleWorkerError
from cavmarl.parallel.placement.step_placement import StepPlacement
from cavmarl.parallel.processes.worker_pool import Pool
from cavmarl.parallel.workers.pooled_worlds import PooledWorlds
from cavmarl.parallel.worlds.tasks import Task
from tests.support.pools import signal_later
from tests.support.replayed import BUSY
from tests.support.rerouting import CARS, DEVICE, FLOW, make_map, write_demand
from tests.support.sumo_worlds import write_stops
from tests.support.vec_runs import Make, drive, pool_of, same

pytestmark = pytest.mark.filterwarnings("ignore:workers = :RuntimeWarning")

# Small environments come first, because every test run uses the first parameters.
SMALL_FIRST = sorted(entries(), key=lambda env: (env not in ("grid4x4", "merge", "ring"), env))
RESTLESS = {"workers.balance_steps": 2, "workers.imbalance_tolerance": 0.0, "workers.max_moves": 64}


@pytest.fixture
def moves_per_round(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Replace measured costs by random costs; return the number of moves of each round."""
    rng = np.random.default_rng(3)
    moved: list[int] = []
    round_ = StepPlacement.round

    def round_with_random_costs(self: StepPlacement, spent_s: Any, steps: int, pids: Any) -> bool:
        wrong = self._before_s + rng.exponential(1.0, spent_s.shape) ** 3
        result = round_(self, wrong, steps, pids)
        moved.append(sum(len(plan.moves) for plan in self.plans))
        return result

    monkeypatch.setattr(StepPlacement, "round", round_with_random_costs)
    return moved


@pytest.mark.parametrize(("number", "env"), list(enumerate(SMALL_FIRST)))
def test_moving_worlds_changes_no_result(
    make: Make, moves_per_round: list[int], number: int, env: str
) -> None:
    """Each environment is tested with one number of zones and workers, chosen by its index."""
    wanted = {"num_envs": 6, "max_cycles": 8, "zones": (1, 4)[number % 2]}
    whole = drive(make(env, **wanted))
    vec = make(env, workers=(2, 2, 3, 3)[number % 4], overrides=RESTLESS, **wanted)
    assert same(drive(vec), whole)
    assert sum(moves_per_round) > 0


def test_worlds_keep_their_journals(
    make: Make, moves_per_round: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("secrets.token_bytes", lambda size: bytes(range(size)))

    def run(name: str, workers: int, kills: bool = False) -> tuple[Any, list[bytes]]:
        folder = tmp_path / name
        folder.mkdir()
        overrides = {**BUSY, "zones.journal": str(folder / "run.jsonl")}
        if workers:
            overrides |= RESTLESS
        vec = make("grid4x4", num_envs=3, zones=2, workers=workers, overrides=overrides)
        vec.reset(seed=3)
        found = []
        for step in range(24):
            if kills and step % 3:
                os.kill(pool_of(vec).pids[step % workers], signal.SIGKILL)
            found.append(vec.step(vec.suggest_actions())[0].tobytes())
        vec.close()
        return found, [path.read_bytes() for path in sorted(folder.iterdir())]

    whole = run("alone", 0)
    assert run("moving", 2) == whole
    assert run("killed", 2, kills=True) == whole
    assert sum(moves_per_round) > 0


STACKED = {"sensors.stack": 3, "population.mode": "respawn", "action.kind": "discrete"}


@pytest.mark.parametrize("more", [{"autoreset_mode": "NextStep"}, {"overrides": STACKED}])
def test_moving_worlds_with_other_settings_changes_no_result(
    make: Make, moves_per_round: list[int], more: dict[str, Any]
) -> None:
    wanted = {"num_envs": 5, "agents": 3, "background": 10, "max_cycles": 5, **more}
    whole = drive(make("merge", **wanted), steps=20)
    wanted["overrides"] = {**wanted.get("overrides", {}), **RESTLESS}
    assert same(drive(make("merge", workers=3, **wanted), steps=20), whole)
    assert sum(moves_per_round) > 0


def test_rerouted_vehicles_keep_their_routes(
    make: Make, moves_per_round: list[int], tmp_path: Path
) -> None:
    files = write_demand(tmp_path, CARS.format(device=DEVICE) + FLOW)
    overrides = {
        "traffic.demand": [str(path) for path in files],
        "clock.sim_dt_s": 0.2,
        "clock.ctrl_dt_s": 1.0,
        "horizon_s": 600.0,
        "population.mode": "respawn",
        **RESTLESS,
    }
    wanted = {"num_envs": 4, "agents": 1, "background": 0, "overrides": overrides}
    net = str(make_map(tmp_path))
    whole = make(net, **wanted)
    before = drive(whole, steps=400)
    assert whole.traffic_stats()["rerouted"] > 0
    assert same(drive(make(net, workers=2, **wanted), steps=400), before)
    assert sum(moves_per_round) > 0


def test_worlds_with_sumo_demand_keep_their_routes(
    make: Make, moves_per_round: list[int], tmp_path: Path
) -> None:
    """Each worker stores the routes and stops of the demand at its own indices."""
    pytest.importorskip("libsumo", reason="needs the extra 'sumo'")
    overrides: dict[str, Any] = {
        "traffic.source": "sumo-demand",
        "traffic.demand": [str(path) for path in write_stops(tmp_path)],
        "sensors.signal.timing": False,
        "clock.sim_dt_s": 0.2,
        "clock.ctrl_dt_s": 1.0,
    }
    wanted = {"num_envs": 3, "agents": 1, "background": 0}
    whole = drive(make("merge", overrides=overrides, **wanted), steps=40)
    vec = make("merge", workers=2, overrides=overrides | RESTLESS, **wanted)
    assert same(drive(vec, steps=40), whole)
    assert sum(moves_per_round) > 0


def test_some_worlds_are_reset_in_any_worker(make: Make, moves_per_round: list[int]) -> None:
    chosen = np.array([False, True, False, True, True])
    found = []
    for workers in (0, 2):
        vec = make("merge", num_envs=5, agents=2, workers=workers, overrides=RESTLESS)
        drive(vec, steps=9)
        observations, infos = vec.reset(options={"reset_mask": chosen})
        vec.step(vec.suggest_actions())
        found.append([observations, infos["mask"], *(vec.state_hash(w) for w in range(5))])
    assert same(*found)
    assert sum(moves_per_round) > 0


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("split", [False, True])
def test_workers_that_die_during_a_move_change_no_result(
    make: Make,
    moves_per_round: list[int],
    monkeypatch: pytest.MonkeyPatch,
    how: signal.Signals,
    split: bool,
) -> None:
    wanted = {"num_envs": 1 if split else 5, "agents": 5, "background": 30, "max_cycles": 9}
    whole = drive(make("grid4x4", **wanted), steps=40)
    vec = make("grid4x4", zones=4, workers=2, overrides=RESTLESS, **wanted)
    rng = random.Random(2)
    run, timers = Pool.run, []

    def run_and_signal(self: Pool, task: int, payload: Any = None, commits: bool = True) -> Any:
        if task in (Task.PACK, Task.UNPACK, Task.HOST) and len(timers) < 8:
            pid = self.pids[rng.randrange(2)]
            timers.append(signal_later(pid, rng.uniform(0.0, 0.003), how))
        return run(self, task, payload, commits)

    monkeypatch.setattr(Pool, "run", run_and_signal)
    assert same(drive(vec, steps=40, before=lambda _: [t.join() for t in timers]), whole)
    assert len(pool_of(vec).deaths) > 3
    assert sum(moves_per_round) > 0


@pytest.mark.parametrize("split", [False, True])
def test_a_worker_that_dies_after_moves_resumes_with_its_present_worlds(
    make: Make, moves_per_round: list[int], split: bool
) -> None:
    wanted = {"num_envs": 1 if split else 5, "agents": 3, "background": 20, "max_cycles": 30}
    whole = drive(make("grid4x4", **wanted), steps=45)
    vec = make("grid4x4", zones=4, workers=2, overrides=RESTLESS, **wanted)

    def kill_in_step(step: int) -> None:
        if step % 9 == 8:
            os.kill(pool_of(vec).pids[step % 2], signal.SIGKILL)
        if step == 30:
            os.kill(pool_of(vec).server_pid, signal.SIGKILL)

    assert same(drive(vec, steps=45, before=kill_in_step), whole)
    assert sum(moves_per_round) > 0


def test_a_failed_move_changes_nothing(
    make: Make, moves_per_round: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = {"num_envs": 5, "agents": 3}
    whole = drive(make("ring", **wanted))
    vec = make("ring", workers=2, overrides=RESTLESS, **wanted)
    run, failed = Pool.run, []

    def interrupt(self: Pool, task: int, payload: Any = None, commits: bool = True) -> Any:
        if task == Task.UNPACK and not failed:
            failed.append(task)
            self._open = self._all  # as if the interrupt came while the world moves
            raise KeyboardInterrupt
        return run(self, task, payload, commits)

    monkeypatch.setattr(Pool, "run", interrupt)
    step = type(vec).step

    def step_again(self: Any, actions: Any) -> Any:
        before = self.worlds.plans
        try:
            return step(self, actions)
        except KeyboardInterrupt:
            assert self.worlds.plans == before
            return step(self, actions)

    monkeypatch.setattr(type(vec), "step", step_again)
    assert same(drive(vec), whole)
    assert failed
    assert sum(moves_per_round) > 0


def test_worlds_are_assigned_by_their_measured_costs(make: Make) -> None:
    """Measured costs replace the number of worlds as the cost of a plan."""
    overrides = {"workers.balance_steps": 10, "workers.imbalance_tolerance": 0.05}
    vec = make("merge", num_envs=8, agents=1, background=60, workers=2, overrides=overrides)
    assert isinstance(vec.worlds, PooledWorlds)
    first = vec.worlds.plans
    assert [plan.problem.cost_source for plan in first] == ["number"]
    drive(vec, steps=60)
    (plan,) = vec.worlds.plans
    assert plan.problem.cost_source == "measured"
    assert all(0.0 < shard.cost_s < 1.0 for shard in plan.problem.shards)
    assert replan(plan, plan.problem.snapshot) == plan


def test_the_plan_is_logged_at_a_reset(make: Make, caplog: pytest.LogCaptureFixture) -> None:
    vec = make("ring", num_envs=3, workers=2)
    with caplog.at_level(logging.INFO, logger="cavmarl.workers"):
        vec.reset(seed=0)
        assert caplog.messages == [vec.plan_text()]
        vec.reset(options={"reset_mask": np.array([True, False, False])})
        assert len(caplog.messages) == 1
    assert "3 worlds on 2 workers" in vec.plan_text()
    assert [plan_from_dict(plan.to_dict()) for plan in vec.plans] == list(vec.plans)
    assert make("ring").plan_text() == ""


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("balance_steps", -1, "from 0 to 1000000"),
        ("imbalance_tolerance", -0.1, "0"),
        ("imbalance_tolerance", float("nan"), "from 0 to 100"),
        ("max_moves", 0, "from 1"),
    ],
)
def test_bad_settings_are_refused(key: str, value: float, words: str) -> None:
    with pytest.raises(ConfigError, match=rf"workers\.{key}.*{words}"):
        make_vec("ring", workers=1, overrides={f"workers.{key}": value})


def test_workers_on_busy_machines_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    busy = LoadSnapshot(
        (Candidate(0, Utilisation(0.1, 0.1)), Candidate(1, Utilisation(0.9, 0.1))), "none", ""
    )
    monkeypatch.setattr("cavmarl.balance.probe.take_snapshot", lambda workers: busy)
    with pytest.raises(NoAdmissibleWorkerError, match=r"worker 1.*cpu.*fewer workers"):
        make_vec("ring", num_envs=4, workers=2, overrides={"workers.monitor_cpu": True})


@pytest.mark.parametrize("env", ["grid4x4", "merge", "town"])
def test_moving_zones_to_other_workers_changes_no_result(
    make: Make, moves_per_round: list[int], env: str
) -> None:
    wanted = {"agents": 8, "background": 30, "max_cycles": 8}
    whole = drive(make(env, **wanted))
    for zones, workers in ((4, 2), (9, 3)):
        moves_per_round.clear()
        vec = make(env, zones=zones, workers=workers, overrides=RESTLESS, **wanted)
        assert same(drive(vec), whole), (zones, workers)
        assert sum(moves_per_round) > 0
