"""Whole worlds over nodes have the results of one process, even if nodes are killed."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from cavmarl import ConfigError, make_vec
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.core.errors import WorkerDeathError
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.nodes.node_groups import NodeGroups
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.parallel.placement.step_placement import StepPlacement
from cavmarl.parallel.worlds.tasks import Task
from tests.support.vec_runs import Make, drive, same

WANTED: dict[str, Any] = {"env": "grid4x4", "num_envs": 3, "agents": 6, "background": 20}
WANTED |= {"max_cycles": 8}


def groups_of(vec: CavVectorEnv) -> list[NodeWorlds]:
    assert isinstance(vec.worlds, NodeGroups)
    return vec.worlds.groups


def pids_of(vec: CavVectorEnv) -> list[int]:
    return [pid for group in groups_of(vec) for pid in group.pool.pids]


def kill(vec: CavVectorEnv, at: dict[int, list[int]]) -> Callable[[int], None]:
    """Return a function that kills the node of each group in `at[step]`."""

    def kill_in_step(step: int) -> None:
        for group in at.get(step, ()):
            os.kill(groups_of(vec)[group].pool.pids[0], signal.SIGKILL)

    return kill_in_step


@pytest.mark.parametrize(
    ("arguments", "nodes"),
    [
        ({}, 2),
        ({"zones": 4, "overrides": {"zones.repartition_steps": 3}}, 3),
        ({"env": "merge", "num_envs": 2, "autoreset_mode": "NextStep"}, 2),
        ({"env": "town", "overrides": {"population.mode": "respawn", "sensors.stack": 3}}, 2),
        ({"env": "town", "overrides": {"clock.control_latency_ticks": 2, "v2x.enabled": True}}, 3),
        ({"env": "town", "agents": 2, "overrides": {"rig": "ten_sensors"}}, 2),
    ],
)
def test_whole_worlds_over_nodes_equal_those_of_one_process(
    make: Make, arguments: dict[str, Any], nodes: int
) -> None:
    wanted = WANTED | arguments
    whole = drive(
        make(
            **wanted
            | {
                "zones": 1,
                "overrides": {
                    key: value
                    for key, value in wanted.get("overrides", {}).items()
                    if "zones" not in key
                },
            }
        )
    )
    vec = make(backend=f"nodes:{nodes}", **wanted)
    assert same(drive(vec), whole)
    assert same(drive(vec), whole)
    assert len(set(pids_of(vec))) == nodes
    assert all(group.pool.losses == 0 for group in groups_of(vec))


@pytest.mark.parametrize(
    "arguments", [{}, {"zones": 2}, {"env": "town", "overrides": {"rig": "ten_sensors"}}]
)
def test_killed_nodes_change_no_result(make: Make, arguments: dict[str, Any]) -> None:
    wanted = WANTED | arguments
    whole = drive(make(**wanted | {"zones": 1}), steps=20)
    vec = make(backend="nodes:2", **wanted)
    found = drive(vec, steps=20, before=kill(vec, {0: [0], 5: [1], 12: [0, 1], 13: [0]}))
    assert same(found, whole)
    assert [group.pool.losses for group in groups_of(vec)] == [3, 2]
    assert [group.pool.recoveries for group in groups_of(vec)] == [3, 2]


def test_a_stopped_node_counts_as_lost(make: Make) -> None:
    whole = drive(make(**WANTED))
    vec = make(backend="nodes:2", **WANTED)

    def stop(step: int) -> None:
        if step == 4:
            os.kill(groups_of(vec)[1].pool.pids[0], signal.SIGSTOP)

    assert same(drive(vec, before=stop), whole)
    assert [group.pool.losses for group in groups_of(vec)] == [0, 1]


def test_repeatedly_killed_nodes_end_the_run(make: Make) -> None:
    vec = make(backend="nodes:2", overrides={"workers.max_retries": 1}, **WANTED)
    drive(vec, steps=2)
    pool = groups_of(vec)[0].pool
    tell = pool.send_zones

    def send_and_kill(*told: Any, **more: Any) -> None:
        tell(*told, **more)
        os.kill(pool.pids[0], signal.SIGKILL)

    pool.send_zones = send_and_kill  # type: ignore[method-assign]
    os.kill(pool.pids[0], signal.SIGKILL)
    with pytest.raises(WorkerDeathError, match=r"zones 0"):
        drive(vec, steps=2)


def test_all_nodes_undo_a_step_that_fails_for_one_node(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    vecs = [make(**WANTED), make(backend="nodes:3", **WANTED)]
    for vec in vecs:
        vec.reset(seed=3)
    group, failing = groups_of(vecs[1])[1], [False]
    perform = group.perform

    def fail(task: Task, payload: Any = None) -> None:
        if failing[0]:
            raise KeyboardInterrupt
        perform(task, payload)

    monkeypatch.setattr(group, "perform", fail)
    for step in range(12):
        actions = vecs[0].suggest_actions()
        vecs[0].step(actions)
        if step in (2, 3, 7):
            failing[0] = True
            with pytest.raises(KeyboardInterrupt):
                vecs[1].step(actions)
            failing[0] = False
        vecs[1].step(actions)
        assert [vecs[0].state_hash(w) for w in range(3)] == [
            vecs[1].state_hash(w) for w in range(3)
        ]


def test_saved_worlds_resume_with_another_backend(make: Make) -> None:
    vec, one = make(backend="nodes:2", **WANTED), make(**WANTED)
    for each in (vec, one):
        each.reset(seed=1)
        for _ in range(3):
            each.step(each.suggest_actions())
    saved = vec.worlds.save_worlds()
    assert saved == one.worlds.save_worlds()
    other = make(backend="nodes:3", **WANTED)
    other.reset(seed=9)
    other.load_state(one.save_state())
    for _ in range(4):
        actions = one.suggest_actions()
        for each in (one, other):
            each.step(actions)
    assert [one.state_hash(w) for w in range(3)] == [other.state_hash(w) for w in range(3)]
    assert np.array_equal(one.state(), other.state())
    with pytest.raises(ConfigError, match="other worlds"):
        vec.worlds.load_worlds([b"", *saved[1:]])


def test_worlds_over_nodes_are_drawn(make: Make) -> None:
    shown = [make(render_mode="rgb_array", **more, **WANTED) for more in ({}, {"nodes": 2})]
    for vec in shown:
        vec.reset(seed=1)
    pictures = [vec.render() for vec in shown]
    assert np.array_equal(pictures[0], pictures[1])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"num_envs": 2, "sensor_workers": 1}, r"workers\.sensors = 1"),
        ({"overrides": {"workers.monitor_cpu": True}}, r"monitor_cpu = True: whole worlds on node"),
        (
            {"overrides": {"workers.balance_steps": 3, "zones.journal": "a.jsonl"}},
            r"zones\.journal = 'a.jsonl' with workers\.balance_steps",
        ),
    ],
)
def test_bad_settings_are_refused(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make_vec(backend="nodes:2", **WANTED | arguments)


RESTLESS = {"workers.balance_steps": 3, "workers.imbalance_tolerance": 0.0}


@pytest.fixture
def changing_costs(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Make another world the most expensive one in each round of balancing."""
    spent, rounds = StepPlacement.round, list[int]()

    def turn(self: StepPlacement, spent_s: Any, steps: int, seen: LoadSnapshot) -> bool:
        dear = len(rounds) % len(spent_s)
        rounds.append(dear)
        spent_s[dear] += 10.0 ** len(rounds)
        return spent(self, spent_s, steps, seen)

    monkeypatch.setattr(StepPlacement, "round", turn)
    return rounds


@pytest.mark.parametrize(
    ("arguments", "at"),
    [
        ({"num_envs": 6}, {}),
        ({"num_envs": 6, "zones": 2}, {4: [0], 7: [1], 10: [0, 1]}),
        ({"env": "merge", "num_envs": 5, "autoreset_mode": "NextStep"}, {}),
        ({"env": "town", "num_envs": 4, "overrides": {"sensors.stack": 3}}, {6: [1]}),
    ],
)
def test_moving_worlds_changes_no_result(
    make: Make, changing_costs: list[int], arguments: dict[str, Any], at: dict[int, list[int]]
) -> None:
    wanted = WANTED | arguments
    whole = drive(make(**wanted | {"zones": 1}), steps=20)
    wanted["overrides"] = {**wanted.get("overrides", {}), **RESTLESS}
    vec = make(backend="nodes:2", **wanted)
    assert same(drive(vec, steps=20, before=kill(vec, at)), whole)
    mover = vec.worlds.mover
    assert mover is not None
    assert mover.moves > 3
    assert sum(group.pool.losses for group in groups_of(vec)) == sum(map(len, at.values()))


def test_an_interrupted_move_is_undone(
    make: Make, changing_costs: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = WANTED | {"num_envs": 6}
    whole = make(**wanted)
    vec = make(backend="nodes:2", overrides=RESTLESS, **wanted)
    for each in (whole, vec):
        each.reset(seed=3)
    group, calls = groups_of(vec)[1], [0]
    set_worlds = group.set_worlds

    def interrupt(*worlds: Any) -> None:
        calls[0] += 1
        if calls[0] in (1, 4):
            raise KeyboardInterrupt
        set_worlds(*worlds)

    monkeypatch.setattr(group, "set_worlds", interrupt)
    for _ in range(20):
        actions = whole.suggest_actions()
        whole.step(actions)
        try:
            vec.step(actions)
        except KeyboardInterrupt:
            vec.step(actions)
        hashes = [[each.state_hash(w) for w in range(6)] for each in (whole, vec)]
        assert hashes[0] == hashes[1]
    assert calls[0] > 5
