"""Worlds over simulated nodes: a run is a function of its seed, and goes through what happens."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from cavmarl.cli import app
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import World, make_world
from cavmarl.handoff.division import Division
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.parallel.network.transport import Bytes
from cavmarl.parallel.nodes.agent_stream import AgentStream
from cavmarl.parallel.nodes.link import FrameKind
from cavmarl.parallel.nodes.links import Links
from cavmarl.parallel.nodes.node_system import NodeSystem
from cavmarl.parallel.nodes.peer_faults import LinkLostError
from cavmarl.parallel.nodes.row_stream import RowStream
from cavmarl.verify.simulated_machine import SimulatedListener, SimulatedMachine, SimulatedSocket
from cavmarl.verify.simulated_nodes import MIXES, SimulatedLine, verify_simulated_nodes

CHECKED = "zones.check_invariants"
SMALL: dict[str, Any] = {"agents": 3, "background": 12, "zones": 3, "steps": 8}


@pytest.fixture(scope="module")
def world() -> World:
    config, base_dir = load_config("merge", agents=1, background=0)
    return make_world(config, base_dir)


def exchange(
    world: World, seed: int, change: Callable[[SimulatedSocket], None] = lambda end: None
) -> tuple[list[str], float]:
    """What two processes say to each other, and how long that takes."""
    machine = SimulatedMachine(seed, world)
    listener = SimulatedListener(machine, machine.caller)
    heard: list[str] = []

    def node(system: NodeSystem) -> None:
        links = Links(lambda number, frame: None, system)
        links.add(COORDINATOR, system.open(listener.place, bytes(32), 0, None))
        for n in range(5):
            links.send(COORDINATOR, FrameKind.SHARE, n)
            links.take([COORDINATOR])
        heard.append(f"node at {machine.now_s:.9f}")
        links.close()

    machine.start("node", node)
    system = machine.system(machine.caller)
    machine.wait(machine.caller, listener.is_readable, None)
    ((number, connection),) = listener.admit()
    change(machine.connections[0][0])
    links = Links(lambda number, frame: None, system)
    links.add(number, connection)
    for n in range(5):
        links.take([number])
        links.send(number, FrameKind.SYNC, n)
    assert machine.outlived(60.0) == []
    machine.close()
    return heard, machine.now_s


def test_what_happens_is_a_function_of_the_seed(world: World) -> None:
    heard, took_s = exchange(world, 3)
    assert (heard, took_s) == exchange(world, 3)
    assert 0.0 < took_s < 0.05
    assert exchange(world, 4) != (heard, took_s)


def test_bytes_that_change_on_the_way_are_noticed(world: World) -> None:
    def double(end: SimulatedSocket) -> None:
        end.due = lambda data: [data, data]

    with pytest.raises(LinkLostError, match="not the next one"):
        exchange(world, 3, double)


def test_a_connection_without_answers_ends(world: World) -> None:
    with pytest.raises(LinkLostError):
        exchange(world, 3, SimulatedSocket.fall_silent)


def test_processes_that_wait_for_each_other_are_noticed(world: World) -> None:
    machine = SimulatedMachine(0, world)
    with pytest.raises(AssertionError, match="wait for ever"):
        machine.wait(machine.caller, lambda: False, None)


@pytest.mark.parametrize("mix", ["none", "kill", "stop", "damage", "part", "end_caller_at_point"])
def test_worlds_go_through_it(mix: str) -> None:
    found = verify_simulated_nodes("merge", [3], mixes=[mix], seeds=1, **SMALL)
    (line,) = found.lines
    assert found.holds, line.wrong
    loses = 0 if mix in ("none", "end_caller_at_point") else 1
    assert line == SimulatedLine(3, mix, runs=1, lost=loses, back=loses)
    assert found == verify_simulated_nodes("merge", [3], mixes=[mix], seeds=1, **SMALL)


def test_nodes_that_do_not_heed_an_order_to_go_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """The campaign finds it: they wait for ever for a node that only the caller misses."""
    monkeypatch.setattr(Links, "heed", lambda self: None)
    found = verify_simulated_nodes("merge", [3], mixes=["part"], seeds=3, **SMALL)
    assert not found.holds


@pytest.mark.slow
def test_frames_that_are_not_guarded(monkeypatch: pytest.MonkeyPatch) -> None:
    """The campaign finds it: a frame that is damaged, or comes twice, is taken for another one.

    What it says is checked, too, so that most of them are refused for that.
    """
    monkeypatch.setattr("cavmarl.parallel.nodes.link.xxh3_64_intdigest", lambda data, seed=0: 0)
    found = verify_simulated_nodes("merge", [3], mixes=["damage", "duplicate"], seeds=40, **SMALL)
    assert not found.holds


def test_owners_are_checked_over_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """An epoch that no record has is noticed, though the vehicles move as they should."""
    checked: dict[str, Any] = {**SMALL, "steps": 30, "overrides": {CHECKED: True}}
    assert verify_simulated_nodes("merge", [3], mixes=["kill"], seeds=1, **checked).holds
    take_over = Division.take_over

    def later(self: Division, w: int, zone: int, vehicle: int, epoch: int, state: bytes) -> None:
        take_over(self, w, zone, vehicle, epoch + 1, state)

    monkeypatch.setattr(Division, "take_over", later)
    found = verify_simulated_nodes("merge", [3], mixes=["none"], seeds=1, **checked)
    assert "on record are" in found.lines[0].wrong[0]
    unchecked = {**checked, "overrides": {}}
    assert verify_simulated_nodes("merge", [3], mixes=["none"], seeds=1, **unchecked).holds


@pytest.mark.parametrize("stream", [RowStream, AgentStream])
def test_a_node_that_says_what_cannot_be_is_lost(
    monkeypatch: pytest.MonkeyPatch, stream: type[RowStream] | type[AgentStream]
) -> None:
    """A whole frame, of which the words cannot be: a connection ends, and no node fails."""
    packed: Any = stream.packed
    send = Links.send
    calls = 0
    kinds = set()

    def note(self: Links, to: int, kind: FrameKind, *rest: Any) -> None:
        kinds.add(kind)
        send(self, to, kind, *rest)

    def cut_short(self: object, *arguments: Any) -> Bytes:
        nonlocal calls
        calls += 1
        data: memoryview = packed(self, *arguments)
        return data[:-8] if calls == 20 else data

    monkeypatch.setattr(stream, "packed", cut_short)
    monkeypatch.setattr(Links, "send", note)
    (line,) = verify_simulated_nodes("merge", [3], mixes=["none"], seeds=1, **SMALL).lines
    assert calls > 20
    assert FrameKind.MISSED in kinds
    assert FrameKind.FAILED not in kinds
    assert line == SimulatedLine(3, "none", runs=1, lost=1, back=1)


@pytest.mark.slow
def test_many_runs(tmp_path: Path) -> None:
    words = ("verify", "merge", "--nodes", "1,2,4", "--faults", "simulated", "--seeds", "2")
    result = CliRunner().invoke(app, [*words, "--json", str(tmp_path / "found.json")])
    assert result.exit_code == 0, result.output
    assert result.output.count("equal") == 3 * len(MIXES)


@pytest.mark.parametrize(
    ("nodes", "keys", "words"),
    [
        ([0], {}, "name at least one number"),
        ([2], {"steps": 3}, "steps = 3: a run needs 4 or more"),
        ([2], {"mixes": ["flood"]}, "must be among none, kill"),
    ],
)
def test_bad_input(nodes: list[int], keys: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        verify_simulated_nodes("merge", nodes, **keys)
