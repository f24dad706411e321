"""Repartitioned worlds over nodes equal undivided worlds, even if nodes are lost."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from cavmarl.env.vector import CavVectorEnv
from cavmarl.handoff.coordinator.journal import JournalReader
from cavmarl.ownership.messages import Reset
from cavmarl.parallel.nodes import node_process
from cavmarl.parallel.nodes.node_cuts import read_neighbours, read_zones, zones_as_json
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.render import topdown
from cavmarl.verify.simulated_nodes import verify_simulated_nodes
from cavmarl.zones.partition.zone_layouts import cut_map
from tests.support.rerouting import CARS, DEVICE, FLOW, make_map, write_demand
from tests.support.vec_runs import Make, drive, same

WANTED: dict[str, Any] = {"agents": 8, "background": 40, "max_cycles": 10}
OFTEN = {
    "zones.repartition_steps": 3,
    "zones.repartition_tolerance": 0.0,
    "zones.check_invariants": True,
}


def over_nodes(vec: CavVectorEnv) -> NodeWorlds:
    assert isinstance(vec.worlds, NodeWorlds)
    return vec.worlds


@pytest.mark.parametrize(
    ("arguments", "nodes"),
    [
        ({"env": "grid4x4", "num_envs": 2}, 3),
        ({"env": "merge", "autoreset_mode": "NextStep"}, 2),
        ({"env": "town", "overrides": {"rig": "ten_sensors", "clock.control_latency_ticks": 2}}, 4),
        ({"env": "town", "overrides": {"v2x.enabled": True, "sensors.stack": 3}}, 2),
    ],
)
def test_repartitioning_changes_no_result(
    make: Make, arguments: dict[str, Any], nodes: int
) -> None:
    wanted = WANTED | arguments
    overrides = wanted.pop("overrides", {})
    whole = drive(make(**wanted, overrides=overrides), steps=24)
    vec = make(**wanted, zones=4, nodes=nodes, overrides=overrides | OFTEN)
    assert same(drive(vec, steps=24), whole)
    worlds = over_nodes(vec)
    assert len(worlds.repartitions) > 2
    assert all(cut.before > cut.after and cut.moved > 0 for cut in worlds.repartitions)
    assert worlds.pool.recoveries == 0


@pytest.mark.slow  # `test_node_parts.py` tests rerouting over nodes in every test run
def test_repartitioning_does_not_change_rerouted_vehicles(make: Make, tmp_path: Path) -> None:
    files = write_demand(tmp_path, CARS.format(device=DEVICE) + FLOW)
    named = {
        "traffic.demand": [str(path) for path in files],
        "clock.sim_dt_s": 0.2,
        "clock.ctrl_dt_s": 1.0,
    }
    wanted = {"env": make_map(tmp_path), "agents": 2, "background": 0, "max_cycles": 40}
    whole = drive(make(**wanted, overrides=named), steps=30)
    vec = make(**wanted, zones=3, nodes=2, overrides=named | OFTEN)
    assert same(drive(vec, steps=30), whole)
    assert over_nodes(vec).repartitions


def test_nodes_that_are_lost_around_a_repartitioning_change_no_result(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After each loss, all nodes return to the zones of the kept state and repartition again."""
    monkeypatch.setattr(
        "cavmarl.parallel.nodes.node_pool.KEEP_S", 1e6
    )  # nodes keep a state only at the start
    wanted = {**WANTED, "max_cycles": 40}
    whole = drive(make("grid4x4", **wanted), steps=24)
    vec = make("grid4x4", zones=4, nodes=4, overrides=OFTEN, **wanted)
    worlds = over_nodes(vec)
    first = worlds.pool.zones

    def kill_in_step(step: int) -> None:
        if step in (5, 7, 18):
            os.kill(worlds.pool.pids[step % len(worlds.pool.pids)], signal.SIGKILL)

    assert same(drive(vec, steps=24, before=kill_in_step), whole)
    assert (worlds.pool.losses, worlds.pool.recoveries > 2) == (3, True)
    assert len(worlds.repartitions) > 1
    assert worlds.pool.zones != first or worlds.pool.replacements


def test_an_interrupted_repartitioning_changes_nothing(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    vecs = [make("grid4x4", **WANTED), make("grid4x4", zones=4, nodes=2, overrides=OFTEN, **WANTED)]
    for vec in vecs:
        vec.reset(seed=2)
    worlds = over_nodes(vecs[1])
    set_neighbours, interrupted = worlds.pool.coordinator.set_neighbours, []

    def interrupt(neighbours: Any) -> None:
        if not interrupted:
            interrupted.append(step)
            raise KeyboardInterrupt
        set_neighbours(neighbours)

    monkeypatch.setattr(worlds.pool.coordinator, "set_neighbours", interrupt)
    for step in range(10):
        actions = vecs[0].suggest_actions()
        vecs[0].step(actions)
        try:
            vecs[1].step(actions)
        except KeyboardInterrupt:
            vecs[1].step(actions)
        assert vecs[0].state_hash() == vecs[1].state_hash(), step
    assert interrupted == [3]
    assert worlds.repartitions


def test_repartitioning_starts_an_episode_in_the_journal(make: Make, tmp_path: Path) -> None:
    path = tmp_path / "run.jsonl"
    overrides = OFTEN | {"zones.journal": str(path)}
    vec = make("grid4x4", zones=4, nodes=2, overrides=overrides, **{**WANTED, "max_cycles": 40})
    drive(vec, steps=20)
    cuts = len(over_nodes(vec).repartitions)
    vec.close()
    episodes = [record.episode for record in JournalReader(path) if isinstance(record, Reset)]
    assert episodes == sorted(set(episodes))
    assert len(episodes) == cuts + 2  # two more episodes: before the first reset, and at the reset
    assert cuts > 1


def test_rendered_frames_show_the_present_zones(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    vec = make("grid4x4", zones=4, nodes=2, overrides=OFTEN, render_mode="rgb_array", **WANTED)
    drive(vec, steps=8)
    before, now = vec.worlds.world.partition, over_nodes(vec).partition
    assert over_nodes(vec).repartitions
    drawn: list[str] = []
    draw = topdown.draw_zones

    def note(surface: Any, partition: Any, *more: Any) -> None:
        drawn.append(partition.content_hash)
        draw(surface, partition, *more)

    monkeypatch.setattr(topdown, "draw_zones", note)
    vec.render()
    assert set(drawn) == {now.content_hash} != {before.content_hash}


def test_zones_and_neighbours_are_sent_without_changes(make: Make) -> None:
    vec = make("grid4x4", agents=1, background=0)
    partition = cut_map(vec.simulation.network, "bisection", 7)
    assert read_zones(zones_as_json(partition)).content_hash == partition.content_hash
    assert read_neighbours([[[0, 1], [1]], True], 2).near == (frozenset({0, 1}), frozenset({1}))


@pytest.mark.parametrize("mix", ["kill", "kill_in_recovery"])
def test_failures_of_simulated_nodes_during_repartitioning_change_no_result(
    monkeypatch: pytest.MonkeyPatch, mix: str
) -> None:
    cuts, ran = [0], node_process.cut_worlds

    def count_and_cut(*told: Any) -> None:
        cuts[0] += 1
        ran(*told)

    monkeypatch.setattr(node_process, "cut_worlds", count_and_cut)
    found = verify_simulated_nodes(
        "merge", [3], mixes=[mix], seeds=6, agents=3, background=20, zones=3, steps=10,
        overrides={"zones.repartition_steps": 2, "zones.repartition_tolerance": 0.0},
    )  # fmt: skip
    (line,) = found.lines
    assert found.holds, line.wrong
    assert line.lost > 1
    assert cuts[0] > 6
