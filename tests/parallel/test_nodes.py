"""Worlds over nodes equal undivided worlds, even if nodes are lost."""

from __future__ import annotations

import os
import random
import signal
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np
import psutil
import pytest

from cavmarl import ConfigError, make_vec, parallel_env
from cavmarl.core.errors import MessageError, WorkerDeathError, WorkerError
from cavmarl.env.vector import CavVectorEnv
from cavmarl.handoff.coordinator.journal import JournalReader
from cavmarl.parallel.nodes.node_actions import Actions, ReceivedActions, read_refusal
from cavmarl.parallel.nodes.node_pool import NodePool
from cavmarl.parallel.nodes.node_starters import LocalNodes
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.parallel.worlds.step_arrays import StepArrays
from tests.support.actuated import actuated_grid
from tests.support.forks import said_in_fork
from tests.support.vec_runs import Make, drive, same

WANTED: dict[str, Any] = {"agents": 8, "background": 30, "max_cycles": 8}
SEATS = {"population.mode": "respawn", "action.kind": "discrete"}


def over_nodes(vec: CavVectorEnv) -> NodeWorlds:
    assert isinstance(vec.worlds, NodeWorlds)
    return vec.worlds


@pytest.mark.parametrize(
    ("arguments", "nodes"),
    [
        ({"env": "grid4x4"}, 2),
        ({"env": "grid4x4", "num_envs": 2}, 3),
        ({"env": "merge", "autoreset_mode": "NextStep"}, 4),
        ({"env": "rush"}, 2),
        ({"env": "town", "overrides": {**SEATS, "sensors.stack": 3}}, 4),
        ({"env": "town", "overrides": {"clock.control_latency_ticks": 2}}, 1),
    ],
)
def test_worlds_over_nodes_equal_those_of_one_process(
    make: Make, arguments: dict[str, Any], nodes: int
) -> None:
    wanted = WANTED | arguments
    whole = drive(make(**wanted))
    vec = make(zones=4, nodes=nodes, **wanted)
    assert same(drive(vec), whole)
    assert same(drive(vec), whole)
    assert len(over_nodes(vec).pool.pids) == nodes
    assert over_nodes(vec).pool.recoveries == 0


def test_an_action_at_the_wrong_node_is_forwarded_to_the_node_of_its_agent(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = drive(make("grid4x4", **WANTED))
    vec = make("grid4x4", zones=4, nodes=3, **WANTED)
    worlds = over_nodes(vec)
    assert same(drive(vec), whole)
    assert (worlds.migrations > 0, worlds.pool.redirected) == (True, 0)

    def mistake(step: int) -> None:
        owned = worlds.pool.owner >= 0
        worlds.pool.owner[owned] = (worlds.pool.owner[owned] + 1) % 3

    assert same(drive(vec, before=mistake), whole)
    assert worlds.pool.redirected > 50


def test_a_node_receives_the_actions_of_its_agents() -> None:
    arrays = StepArrays.of(
        {name: np.zeros((1, 4, 2)) for name in StepArrays._fields[:-2]} | {"mask": np.ones((1, 4))}
    )
    arrays.controls[0, :, 0] = range(4)
    arrays = arrays._replace(mask=np.array([[True, True, True, False]]))
    actions = Actions.of(arrays._replace(meta_actions=np.arange(4)[None]))
    owner = np.array([1, 0, -1, 1], np.int32)
    there = StepArrays(*(array.copy() for array in arrays[:-2]), {}, {})
    there = there._replace(meta_actions=np.zeros((1, 4), np.int64))
    there.controls[...] = -1.0
    taken = ReceivedActions(there, number=1)
    taken.begin(owner)
    data = memoryview(bytes(8) + bytes(actions.of_node(1, owner)))
    wrong, end = taken.read(data, 8, owner)
    assert (wrong.tolist(), end, taken.are_due) == ([], len(data), False)
    assert there.controls[0, :, 0].tolist() == [0.0, -1.0, 2.0, 3.0]
    assert there.meta_actions.tolist() == [[0, 0, 2, 3]]


def test_bad_actions_and_actions_for_other_nodes_are_refused() -> None:
    arrays = StepArrays.of(
        {name: np.ones((1, 4, 2)) for name in StepArrays._fields[:-2]}
        | {"mask": np.ones((1, 4), bool), "meta_actions": np.ones((1, 4), np.int64)}
    )
    owner = np.array([1, 0, 1, -1], np.int32)
    taken = ReceivedActions(arrays, number=1)
    taken.begin(owner)
    told = bytes(Actions.of(arrays).some(np.array([0, 1])))
    wrong, _ = taken.read(memoryview(told), 0, owner)
    assert wrong.tolist() == [1]
    assert taken.are_due, "the actions are complete without agent 2"
    taken.read(memoryview(bytes(Actions.of(arrays).some(np.array([2])))), 0, owner)
    assert not taken.are_due
    words = np.frombuffer(told, np.int64)
    for word, value in ((0, -1), (0, 5), (1, 4), (2, 4), (6, -1)):
        other = words.copy()
        other[word] = value
        with pytest.raises(MessageError, match="not actions of agents"):
            taken.read(memoryview(other.tobytes()), 0, owner)


@pytest.mark.parametrize(
    "found", [bytes(8), np.array([4, 1]).tobytes(), np.array([0, 7]).tobytes()]
)
def test_an_invalid_refusal_of_actions_is_an_error(found: bytes) -> None:
    assert read_refusal(memoryview(np.array([3, 1]).tobytes()), 4, {0, 1}).tolist() == [[3], [1]]
    with pytest.raises(MessageError, match="refusal"):
        read_refusal(memoryview(found), 4, {0, 1})


def test_a_forked_process_cannot_step_or_end_the_nodes(make: Make) -> None:
    vec, whole = make(zones=4, nodes=2, env="grid4x4", **WANTED), make(env="grid4x4", **WANTED)
    assert "the nodes belong to process" in said_in_fork(lambda: drive(vec), vec.close)
    assert same(drive(vec), drive(whole))
    assert over_nodes(vec).pool.recoveries == 0


def test_actuated_signals_and_demand_give_the_results_of_one_process(
    make: Make, tmp_path: Path
) -> None:
    wanted = {"env": str(actuated_grid(tmp_path)), "agents": 4, "background": 40}
    whole = drive(make(**wanted), steps=60)
    vec = make(zones=4, nodes=2, **wanted)
    assert same(drive(vec, steps=60), whole)
    assert over_nodes(vec).migrations > 0


def test_nodes_share_no_writable_memory_with_other_processes(make: Make) -> None:
    vec = make("grid4x4", zones=4, nodes=2, **WANTED)
    drive(vec, steps=3)
    for pid in over_nodes(vec).pool.pids:
        shared = [
            region.path
            for region in psutil.Process(pid).memory_maps(grouped=False)
            if "s" in region.perms and "w" in region.perms
        ]
        assert shared == []


class Killer:
    """A function that kills a node at a random time in each of some steps."""

    def __init__(self, vec: CavVectorEnv, seed: int, *steps: int) -> None:
        self._worlds, self._steps = over_nodes(vec), steps
        self._struck: list[int] = []
        self._random = random.Random(seed)

    def __call__(self, step: int) -> None:
        if step in self._steps:
            pid = self._random.choice(
                [pid for pid in self._worlds.pool.pids if pid not in self._struck]
            )
            self._struck.append(pid)
            Timer(self._random.uniform(0.0, 0.01), os.kill, (pid, signal.SIGKILL)).start()


@pytest.mark.parametrize(("env", "seed"), [("grid4x4", 1), ("town", 2)])
def test_nodes_that_are_lost_at_any_time_change_no_result(make: Make, env: str, seed: int) -> None:
    wanted = {"agents": 6, "background": 60, "max_cycles": 20}
    whole = drive(make(env, **wanted), steps=40)
    vec = make(env, zones=4, nodes=4, **wanted)
    assert same(drive(vec, steps=40, before=Killer(vec, seed, 4, 17, 30)), whole)
    assert over_nodes(vec).pool.recoveries == 3
    assert over_nodes(vec).pool.losses == 3


def test_a_stopped_node_counts_as_lost(make: Make) -> None:
    whole = drive(make("grid4x4", **WANTED))
    vec = make("grid4x4", zones=4, nodes=3, **WANTED)

    def kill_in_step(step: int) -> None:
        if step == 5:
            os.kill(over_nodes(vec).pool.pids[1], signal.SIGSTOP)

    assert same(drive(vec, before=kill_in_step), whole)
    assert over_nodes(vec).pool.losses == 1


def test_two_lost_nodes_that_are_not_neighbours_change_no_result(make: Make) -> None:
    whole = drive(make("grid4x4", **WANTED))
    vec = make("grid4x4", zones=4, nodes=4, **WANTED)
    worlds = over_nodes(vec)

    def kill_in_step(step: int) -> None:
        if step == 5:
            for number in (0, 2):
                os.kill(worlds.pool.pids[number], signal.SIGKILL)

    assert same(drive(vec, before=kill_in_step), whole)
    assert worlds.pool.losses == 2


def test_equal_actions_in_many_steps_are_all_applied(make: Make) -> None:
    wanted = {**WANTED, "max_cycles": 100}
    vecs = [make("grid4x4", **wanted), make("grid4x4", zones=4, nodes=3, **wanted)]
    for vec in vecs:
        vec.reset(seed=2)
    still = np.zeros_like(vecs[0].suggest_actions())
    for step in range(60):
        if step == 50:  # by now, the nodes have kept several states
            os.kill(over_nodes(vecs[1]).pool.pids[0], signal.SIGKILL)
        for vec in vecs:
            vec.step(still)
        assert vecs[0].state_hash() == vecs[1].state_hash(), step


def test_an_interrupted_step_can_be_repeated(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "cavmarl.parallel.nodes.node_pool.KEEP_S", 0.0
    )  # nodes keep a state before each step
    vecs = [make("grid4x4", **WANTED), make("grid4x4", zones=4, nodes=2, **WANTED)]
    for vec in vecs:
        vec.reset(seed=2)
    coordinator = over_nodes(vecs[1]).pool.coordinator
    begin = coordinator.begin
    for step in range(6):
        actions = vecs[0].suggest_actions()
        if step in (2, 3):

            def interrupted(timeout_s: float, after: bool = step == 3) -> None:
                if after:
                    begin(timeout_s)
                raise KeyboardInterrupt

            monkeypatch.setattr(coordinator, "begin", interrupted)
            with pytest.raises(KeyboardInterrupt):
                vecs[1].step(actions)
            monkeypatch.setattr(coordinator, "begin", begin)
        for vec in vecs:
            vec.step(actions)
        assert vecs[0].state_hash() == vecs[1].state_hash(), step
    assert over_nodes(vecs[1]).pool.recoveries == 0


def test_nodes_that_are_lost_while_states_are_kept_change_no_result(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the nodes return to an older state, that state remains available."""
    monkeypatch.setattr("cavmarl.parallel.nodes.node_pool.KEEP_S", 0.0)
    whole = drive(make("grid4x4", **WANTED))
    vec = make("grid4x4", zones=4, nodes=4, **WANTED)
    worlds = over_nodes(vec)
    doomed = {5: worlds.pool.pids[0], 6: worlds.pool.pids[2]}
    commit, steps = worlds.pool.commit, [0]

    def kill_and_commit() -> list[memoryview]:
        if steps[0] in doomed:  # all nodes keep a state in this step
            os.kill(doomed.pop(steps[0]), signal.SIGKILL)
        return commit()

    def note(step: int) -> None:
        steps[0] = step

    monkeypatch.setattr(worlds.pool, "commit", kill_and_commit)
    assert same(drive(vec, before=note), whole)
    assert (worlds.pool.losses, worlds.pool.recoveries) == (2, 2)


def test_the_loss_of_a_node_and_of_its_replica_is_an_error(make: Make) -> None:
    vec = make("grid4x4", zones=4, nodes=4, **WANTED)
    vec.reset(seed=1)
    for number in (1, 2):
        os.kill(over_nodes(vec).pool.pids[number], signal.SIGKILL)
    with pytest.raises(WorkerDeathError, match=r"node 1 was lost.*make the environment again"):
        vec.step(vec.suggest_actions())
    vec.close()
    again = make("grid4x4", zones=4, nodes=4, **WANTED)
    again.reset(seed=1)
    again.step(again.suggest_actions())


def test_the_loss_of_the_only_node_changes_no_result(make: Make) -> None:
    """The caller keeps replicas of the states of the node, and a new node replaces it."""
    whole = drive(make("grid4x4", **WANTED))
    vec = make("grid4x4", zones=2, nodes=1, **WANTED)

    def kill_in_step(step: int) -> None:
        if step in (2, 6):
            os.kill(over_nodes(vec).pool.pids[0], signal.SIGKILL)

    assert same(drive(vec, before=kill_in_step), whole)
    assert (over_nodes(vec).pool.losses, over_nodes(vec).pool.recoveries) == (2, 2)


def test_no_process_or_descriptor_remains(make: Make) -> None:
    vec = make("grid4x4", zones=2, nodes=2, **WANTED)
    vec.reset(seed=1)
    pids = over_nodes(vec).pool.pids
    vec.close()
    assert not any(map(psutil.pid_exists, pids))


def test_a_journal_records_changes_of_owner(make: Make, tmp_path: Path) -> None:
    path = tmp_path / "run.jsonl"
    vec = make("grid4x4", zones=4, nodes=2, overrides={"zones.journal": str(path)}, **WANTED)
    drive(vec, steps=20)
    switched = over_nodes(vec).migrations
    vec.close()
    records = JournalReader(path)
    assert sum(len(getattr(record, "switches", ())) for record in records) == switched > 0


def test_the_pettingzoo_environment_gives_the_results_of_one_process() -> None:
    env = parallel_env("grid4x4", zones=4, nodes=2, agents=3, background=10)
    one = parallel_env("grid4x4", agents=3, background=10)
    for made in (env, one):
        made.reset(seed=4)
    for _ in range(5):
        actions = {agent: np.array([0.2, 0.0], np.float32) for agent in one.agents}
        (seen, *_), (other, *_) = env.step(actions), one.step(actions)
        assert seen.keys() == other.keys()
        assert all(np.array_equal(seen[agent], other[agent]) for agent in seen)
    env.close()
    one.close()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"nodes": 5, "zones": 4}, "needs 1 to 4 nodes"),
        ({"nodes": 0}, "nodes = 0"),
        ({"nodes": 2, "workers": 2}, "leave out workers, or nodes"),
        ({"backend": "nodes:2@here"}, "must be HOST:PORT"),
        ({"backend": "nodes:2@127.0.0.1:7600", "zones": 2}, "without workers.key_file"),
        ({"nodes": 2, "zones": 2, "sensor_workers": 1}, "workers.sensors = 1"),
        (
            {"nodes": 2, "zones": 2, "overrides": {"workers.monitor_cpu": True}},
            r"workers\.monitor_cpu = True.*set workers\.balance_steps",
        ),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make_vec("grid4x4", **arguments)


def test_calls_that_need_the_worlds_in_this_process_are_refused(make: Make) -> None:
    vec = make("grid4x4", zones=2, nodes=2, **WANTED)
    with pytest.raises(ConfigError, match="use backend='local'"):
        _ = vec.simulation
    with pytest.raises(ConfigError, match="cannot be copied"):
        vec.worlds.__reduce__()
    vec.reset(seed=0)
    with pytest.raises(ConfigError, match="the state belongs to other worlds"):
        vec.worlds.load_worlds([b"nothing"])
    vec.step(vec.suggest_actions())


def test_a_node_that_cannot_start_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cavmarl.parallel.nodes.node_starters.NODE", "cavmarl.nothing")
    with pytest.raises(WorkerError, match="before it had begun"):
        make_vec("grid4x4", zones=2, nodes=2)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_node_that_is_killed_or_stopped_before_it_begins_is_replaced(
    make: Make, monkeypatch: pytest.MonkeyPatch, how: signal.Signals
) -> None:
    whole = drive(make("grid4x4", **WANTED))
    start, started = LocalNodes.start, []

    def start_and_signal(self: LocalNodes, number: int) -> Any:
        process = start(self, number)
        started.append(number)
        if len(started) <= 2:
            os.kill(process.pid, how)
        return process

    monkeypatch.setattr(LocalNodes, "start", start_and_signal)
    vec = make("grid4x4", zones=4, nodes=2, overrides={"workers.join_timeout_s": 60.0}, **WANTED)
    assert sorted(started) == [0, 0, 1, 1]
    assert same(drive(vec), whole)
    started.clear()
    words = "ended with exit status -9 before it had begun work; it was killed, .*max_retries"
    with pytest.raises(WorkerError, match=words):
        make("grid4x4", zones=4, nodes=2, overrides={"workers.max_retries": 1}, **WANTED)


@pytest.mark.parametrize(
    ("nodes", "how", "is_told"),
    [
        (1, signal.SIGKILL, True),
        (3, signal.SIGKILL, False),
        (3, signal.SIGKILL, True),
        (3, signal.SIGSTOP, True),
    ],
)
def test_a_node_that_is_lost_while_zones_are_assigned_is_replaced(
    make: Make, monkeypatch: pytest.MonkeyPatch, nodes: int, how: signal.Signals, is_told: bool
) -> None:
    whole = drive(make("grid4x4", **WANTED))
    tell, struck = NodePool.send_zones, list[int]()  # pids of the signaled processes

    def send_and_signal(self: NodePool, *told: Any, **more: Any) -> None:
        process = psutil.Process(self.pids[-1 if struck else 0])
        strikes = len(struck) < 2
        if is_told:
            if strikes:
                process.suspend()  # the suspended process cannot answer before the signal
            tell(self, *told, **more)
        if strikes:
            struck.append(process.pid)
            process.send_signal(how)
            if how == signal.SIGKILL:
                process.wait()
        if not is_told:
            tell(self, *told, **more)

    monkeypatch.setattr(NodePool, "send_zones", send_and_signal)
    vec = make("grid4x4", zones=4, nodes=nodes, **WANTED)
    assert len(set(struck)) == 2
    assert same(drive(vec), whole)
    assert (over_nodes(vec).pool.losses, over_nodes(vec).pool.recoveries) == (2, 0)
    struck.clear()
    with pytest.raises(
        WorkerError, match=f"node {nodes - 1} ended with exit status -9 before it had begun"
    ):
        make("grid4x4", zones=4, nodes=nodes, overrides={"workers.max_retries": 1}, **WANTED)
