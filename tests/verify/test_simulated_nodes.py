"""Faults on a simulated machine are injected and counted; runs stay equal or end with an error."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner
from xxhash import xxh3_64_intdigest

from cavmarl.cli import app
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError, WorkerDeathError, WorkerError
from cavmarl.engine.world_setup import World, make_world
from cavmarl.handoff.owner_changes import OwnerChanges
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.parallel.network.transport import Bytes
from cavmarl.parallel.nodes.agent_stream import AgentStream
from cavmarl.parallel.nodes.link import FrameKind
from cavmarl.parallel.nodes.links import Links
from cavmarl.parallel.nodes.node_system import NodeSystem
from cavmarl.parallel.nodes.peer_faults import LinkLostError
from cavmarl.parallel.nodes.row_stream import RowStream
from cavmarl.verify.simulated_faults import (
    CALLER_DEATHS,
    DEATHS,
    FAULTS,
    TOLERATED,
    TOLERATED_RATES,
    Fault,
    kind_of,
)
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
    """Let two simulated processes exchange messages; return the messages and the end time in s."""
    machine = SimulatedMachine(seed, world)
    listener = SimulatedListener(machine, machine.caller)
    heard: list[str] = []

    def node(system: NodeSystem) -> None:
        links = Links(lambda number, frame: None, system)
        links.add(COORDINATOR, system.open(listener.place, bytes(32), 0, None))
        for n in range(5):
            links.send(COORDINATOR, FrameKind.SHARE, n)
            links.receive([COORDINATOR])
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
        links.receive([number])
        links.send(number, FrameKind.SYNC, n)
    assert machine.outlived(60.0) == []
    machine.close()
    return heard, machine.now_s


def test_the_order_of_events_depends_only_on_the_seed(world: World) -> None:
    heard, took_s = exchange(world, 3)
    assert (heard, took_s) == exchange(world, 3)
    assert 0.0 < took_s < 0.05
    assert exchange(world, 4) != (heard, took_s)


def test_bytes_that_arrive_twice_end_the_connection(world: World) -> None:
    def double(end: SimulatedSocket) -> None:
        end.due = lambda data: [data, data]

    with pytest.raises(LinkLostError, match="out of order"):
        exchange(world, 3, double)


def test_delayed_bytes_arrive_in_the_order_of_sending(world: World) -> None:
    machine = SimulatedMachine(0, world)
    sender, receiver = (SimulatedSocket(machine, machine.caller) for _ in range(2))
    sender.other, receiver.other = receiver, sender
    sender.held_until_s = 1.937175702743636
    sent = [n.to_bytes(4, "big") for n in range(3000)]
    for data in sent:
        machine.now_s += 0.0004 / 3.0
        sender.send([data])
    machine.wait(machine.caller, lambda: len(receiver.received) == len(sent), None)
    assert list(receiver.received) == sent


def test_a_connection_without_answers_ends(world: World) -> None:
    with pytest.raises(LinkLostError):
        exchange(world, 3, SimulatedSocket.fall_silent)


def test_a_machine_whose_processes_all_wait_is_an_error(world: World) -> None:
    machine = SimulatedMachine(0, world)
    with pytest.raises(AssertionError, match="wait forever"):
        machine.wait(machine.caller, lambda: False, None)


def one_line(mix: str, nodes: int = 3, seeds: int = 1, **keys: Any) -> SimulatedLine:
    (line,) = verify_simulated_nodes(
        "merge", [nodes], mixes=[mix], seeds=seeds, **SMALL | keys
    ).lines
    return line


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_injected_and_counted_and_changes_no_result(fault: Fault) -> None:
    line = one_line(fault, seeds=4)
    assert not line.wrong
    assert set(line.injected) == {fault}
    assert (line.runs, line.equal + line.ended) == (4, 4)
    if (
        fault is not Fault.KILL_IN_RECOVERY
    ):  # a run may end, because both nodes with a state may die
        assert (line.equal, line.injected[fault] <= 4) == (4, True)
    assert line.deaths == (line.injected[fault] if fault in DEATHS else 0)
    if fault in TOLERATED:
        assert line.lost == line.recoveries == 0
    elif fault is not Fault.STOP:  # a short stop is tolerated
        assert line.lost == line.injected[fault]


@pytest.mark.parametrize("fault", CALLER_DEATHS)
def test_nodes_end_if_their_caller_dies(fault: Fault) -> None:
    line = one_line(fault, seeds=4)
    assert not line.wrong
    assert line.caller_ended == line.injected[fault] > 0
    assert line.equal == 4 - line.caller_ended


def test_a_run_depends_only_on_its_seed() -> None:
    """Repeat a single run of a campaign."""
    lines = [one_line("many", 2, first_seed=seed) for seed in (5, 6, 5)]
    assert lines[0] == lines[2] != lines[1]
    both = one_line("many", 2, seeds=2, first_seed=5)
    assert both.injected == lines[0].injected + lines[1].injected


def test_faults_drawn_for_each_frame_are_tolerated() -> None:
    tolerated = one_line("many_tolerated", seeds=2)
    assert not tolerated.wrong
    assert set(tolerated.injected) == set(TOLERATED_RATES)
    assert tolerated.injected.total() > 100
    assert (tolerated.equal, tolerated.lost) == (2, 0)
    every = one_line("many", seeds=12)
    assert not every.wrong
    assert every.equal > 0
    assert {*every.injected} > set(TOLERATED_RATES)
    assert every.deaths > 0


def test_the_only_node_resumes_from_the_state_at_the_caller() -> None:
    line = one_line("kill", nodes=1, seeds=2)
    assert (line.wrong, line.equal, line.ended, line.deaths) == ([], 2, 0, 2)


def test_an_unexpected_error_counts_as_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    def other(*arguments: Any) -> Any:
        raise WorkerError("the zones of lost nodes")

    monkeypatch.setattr("cavmarl.parallel.nodes.node_pool.moves_of", other)
    line = one_line("kill")
    assert line.wrong_seeds == [0]
    assert "WorkerError: the zones of lost nodes" in line.wrong[0]


def test_a_run_that_ends_although_a_state_exists_is_detected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Another node has the state of the lost node, so the run must not end."""

    def give_up(*arguments: Any) -> Any:
        raise WorkerDeathError(0, "zone 0", 1, "step", ["it was lost"])

    monkeypatch.setattr("cavmarl.parallel.nodes.node_pool.moves_of", give_up)
    line = one_line("kill")
    assert "ended after 1 losses in a row" in line.wrong[0]


def test_the_loss_of_a_node_that_only_answers_late_is_detected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cavmarl.parallel.nodes.node_watch.PONG_S", 0.01)
    line = one_line("stale_heartbeat")
    assert "nodes were lost to faults that must be tolerated" in line.wrong[0]


def test_nodes_that_ignore_a_rollback_are_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a rollback, nodes wait forever for a node that only the caller has lost."""
    monkeypatch.setattr(Links, "check_recovery", lambda self: None)
    assert one_line("partition", seeds=3).wrong


@pytest.mark.slow
def test_frames_without_a_checksum_are_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a checksum, damaged or repeated frames are taken for valid frames.

    Nodes also check the content of frames, so they refuse most of these frames.
    """
    monkeypatch.setattr("cavmarl.parallel.nodes.link.xxh3_64_intdigest", lambda data, seed=0: 0)
    assert one_line("damage", seeds=12).wrong or one_line("duplicate", seeds=40).wrong


def test_frames_without_a_sequence_number_are_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Send frames twice. Missing frames would be detected by the content of other frames."""
    checksum = "cavmarl.parallel.nodes.link.xxh3_64_intdigest"
    monkeypatch.setattr(checksum, lambda data, seed=0: xxh3_64_intdigest(data))
    assert one_line("duplicate", seeds=8).wrong


def test_a_missing_rollback_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a rollback, nodes continue from their present states and run steps twice."""

    def present(data: Bytes, like: list[Any]) -> list[Any]:
        return [array.copy() for array in like]

    monkeypatch.setattr("cavmarl.parallel.nodes.state_replicas.from_bytes", present)
    assert one_line("kill", seeds=3).wrong


def silence_connection(monkeypatch: pytest.MonkeyPatch, kind: FrameKind, nth: int) -> list[int]:
    """Let a connection between two nodes drop all data from the nth frame of a kind on."""
    send = SimulatedSocket.send
    seen: list[int] = []

    def send_or_fall_silent(self: SimulatedSocket, pieces: Sequence[Bytes]) -> int:
        if kind_of(b"".join(map(bytes, pieces))) is kind and self.other is not None:
            if "caller" not in (self.owner.name, self.other.owner.name):
                seen.append(self.fileno())
                if len(seen) == nth:
                    self.fall_silent()
        return send(self, pieces)

    monkeypatch.setattr(SimulatedSocket, "send", send_or_fall_silent)
    return seen


@pytest.mark.parametrize(
    ("kind", "nth", "mix"),
    [
        (FrameKind.KEEP, 1, "stop_caller"),  # the first state, before any tick
        (FrameKind.SYNC, 2, "stop_caller"),
        (FrameKind.SHARE, 5, "stop_caller"),
        (
            FrameKind.MESSAGES,
            2,
            "stop_caller",
        ),  # an offer, which is the last frame before the nodes wait
        (FrameKind.AGENT, 1, "stop_caller"),
        (FrameKind.GIVE, 1, "kill"),
    ],
)
def test_one_of_two_nodes_with_a_silent_connection_is_lost(
    monkeypatch: pytest.MonkeyPatch, kind: FrameKind, nth: int, mix: str
) -> None:
    """All nodes answer the caller. For any missing frame, one of the two nodes must be lost."""
    seen = silence_connection(monkeypatch, kind, nth)
    keys: dict[str, Any] = {"agents": 12, "background": 20, "zones": 8, "steps": 24}
    found = verify_simulated_nodes(
        "merge", [4], mixes=[mix], seeds=1, overrides={"clock.ctrl_dt_s": 0.4}, **keys
    )
    (line,) = found.lines
    assert len(seen) >= nth
    assert line.lost >= 1
    assert [text for text in line.wrong if "must be tolerated" not in text] == []


def test_a_wrong_epoch_of_a_vehicle_is_detected_over_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The vehicles move correctly, but one has an epoch that no record has."""
    checked: dict[str, Any] = {**SMALL, "steps": 30, "overrides": {CHECKED: True}}
    assert verify_simulated_nodes("merge", [3], mixes=["kill"], seeds=1, **checked).holds
    take_over = OwnerChanges.take_over

    def later(
        self: OwnerChanges, w: int, zone: int, vehicle: int, epoch: int, state: bytes
    ) -> None:
        take_over(self, w, zone, vehicle, epoch + 1, state)

    monkeypatch.setattr(OwnerChanges, "take_over", later)
    found = verify_simulated_nodes("merge", [3], mixes=["none"], seeds=1, **checked)
    assert "4 according to the records" in found.lines[0].wrong[0]
    unchecked = {**checked, "overrides": {}}
    assert verify_simulated_nodes("merge", [3], mixes=["none"], seeds=1, **unchecked).holds


@pytest.mark.parametrize("stream", [RowStream, AgentStream])
def test_a_node_that_sends_an_invalid_frame_is_lost(
    monkeypatch: pytest.MonkeyPatch, stream: type[RowStream] | type[AgentStream]
) -> None:
    """A frame with a valid checksum has invalid content. Its connection ends, and no node fails."""
    packed: Any = stream.packed
    send = Links.send
    calls = 0
    kinds = set()

    def note(self: Links, to: int, kind: FrameKind, *rest: Any) -> None:
        kinds.add(kind)
        send(self, to, kind, *rest)

    def truncate(self: object, *arguments: Any) -> Bytes:
        nonlocal calls
        calls += 1
        data: memoryview = packed(self, *arguments)
        return data[:-8] if calls == 20 else data

    monkeypatch.setattr(stream, "packed", truncate)
    monkeypatch.setattr(Links, "send", note)
    (line,) = verify_simulated_nodes("merge", [3], mixes=["none"], seeds=1, **SMALL).lines
    assert calls > 20
    assert FrameKind.MISSED in kinds
    assert FrameKind.FAILED not in kinds
    assert (line.lost, line.recoveries) == (1, 1)
    assert "1 nodes were lost to faults that must be tolerated" in line.wrong[0]


@pytest.mark.slow
def test_many_runs_of_each_mix_of_faults_change_no_result(tmp_path: Path) -> None:
    words = (
        "verify",
        "nodes",
        "merge",
        "--nodes",
        "1,2,4",
        "--faults",
        "simulated",
        "--seeds",
        "2",
    )
    result = CliRunner().invoke(app, [*words, "--json", str(tmp_path / "found.json")])
    assert result.exit_code == 0, result.output
    assert result.output.count("equal") == 3 * len(MIXES) + 1


@pytest.mark.parametrize(
    ("nodes", "keys", "words"),
    [
        ([0], {}, "must be one or more numbers"),
        ([2], {"steps": 3}, "steps = 3: must be at least 4"),
        ([2], {"mixes": ["flood"]}, "must be among none, delay"),
    ],
)
def test_bad_input_is_refused(nodes: list[int], keys: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        verify_simulated_nodes("merge", nodes, **keys)
