"""A network with injected faults, and worlds over nodes that tolerate these faults."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from cavmarl.cli import app
from cavmarl.core.errors import ConfigError
from cavmarl.verify.faulty_network import FaultyNetwork, NetworkFault
from cavmarl.verify.node_faults import FAULTS, KILL, STOP, verify_node_faults

SMALL: dict[str, Any] = {"agents": 4, "background": 20}


@pytest.fixture
def ends() -> Iterator[tuple[FaultyNetwork, socket.socket, socket.socket]]:
    """Yield a network and the two ends of a connection through the network."""
    network = FaultyNetwork(seed=0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        host, port = network.route(server.getsockname())
        with socket.create_connection((host, port), timeout=5.0) as one:
            other, _ = server.accept()
            with other:
                other.settimeout(5.0)
                one.sendall(b"hello")
                assert other.recv(100) == b"hello"
                yield network, one, other
    network.close()


def test_a_connection_carries_both_directions(
    ends: tuple[FaultyNetwork, socket.socket, socket.socket],
) -> None:
    _, one, other = ends
    other.sendall(b"there")
    assert one.recv(100) == b"there"
    one.close()
    assert other.recv(100) == b""


def exchange_words(one: socket.socket, other: socket.socket) -> list[bytes]:
    """Send a word in each direction; return the received words, empty if nothing arrives."""
    found = []
    for source, target in ((one, other), (other, one)):
        source.sendall(b"word")
        try:
            found.append(target.recv(100))
        except TimeoutError:
            found.append(b"")
    return found


@pytest.mark.parametrize(("fault", "wanted"), [(NetworkFault.DELAY, 0), (NetworkFault.DAMAGE, 1)])
def test_bytes_are_delayed_or_damaged(
    ends: tuple[FaultyNetwork, socket.socket, socket.socket], fault: NetworkFault, wanted: int
) -> None:
    network, one, other = ends
    network.inject(fault)
    first = exchange_words(one, other)
    bits = sum(
        (mine ^ theirs).bit_count()
        for came in first
        for mine, theirs in zip(came, b"word", strict=True)
    )
    assert bits == wanted
    assert exchange_words(one, other) == [b"word", b"word"]
    assert network.done == {fault: 1}


def test_a_silenced_direction_stays_silent(
    ends: tuple[FaultyNetwork, socket.socket, socket.socket],
) -> None:
    network, one, other = ends
    for end in (one, other):
        end.settimeout(0.2)
    network.inject(NetworkFault.SILENCE)
    assert sorted(exchange_words(one, other)) == [b"", b"word"]
    assert sorted(exchange_words(one, other)) == [b"", b"word"]


def test_a_cut_closes_both_ends(ends: tuple[FaultyNetwork, socket.socket, socket.socket]) -> None:
    network, one, other = ends
    network.inject(NetworkFault.CUT)
    assert one.recv(100) == other.recv(100) == b""


def test_the_delays_of_consecutive_pieces_overlap() -> None:
    num, apart_s, latency_s = 20, 0.005, 0.05
    network = FaultyNetwork(seed=0, latency_s=latency_s)
    try:
        with socket.create_server(("127.0.0.1", 0)) as server:
            with socket.create_connection(network.route(server.getsockname())) as one:
                other, _ = server.accept()
                with other:
                    began_s = time.perf_counter()
                    for _ in range(num):
                        one.sendall(b"word")
                        time.sleep(apart_s)
                    one.shutdown(socket.SHUT_WR)
                    came = b""
                    while data := other.recv(100):
                        came += data
                    took_s = time.perf_counter() - began_s
    finally:
        network.close()
    assert came == num * b"word"
    assert latency_s <= took_s < num * latency_s


def test_no_threads_or_sockets_remain() -> None:
    before = set(threading.enumerate())
    network = FaultyNetwork(seed=0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        with socket.create_connection(network.route(server.getsockname())) as one:
            other, _ = server.accept()
            other.close()
            assert one.recv(1) == b""
    network.close()
    for thread in set(threading.enumerate()) - before:
        thread.join(5.0)
    assert set(threading.enumerate()) <= before


@pytest.mark.parametrize("fault", [NetworkFault.DAMAGE, NetworkFault.SILENCE, STOP])
def test_worlds_over_the_faulty_network_equal_the_undivided_one(fault: str) -> None:
    found = verify_node_faults("merge", [3], faults=[fault], seeds=1, zones=3, steps=25, **SMALL)
    (line,) = found.lines
    assert found.holds
    assert (line.kind, line.runs, line.equal, line.ended) == (fault, 1, 1, 0)
    assert line.injected == {fault: 2}
    assert 1 <= line.lost <= 2


def test_each_killed_node_is_replaced_before_the_next_one_is_killed() -> None:
    found = verify_node_faults("merge", [2], faults=[KILL], seeds=1, per_run=3, zones=2, **SMALL)
    assert found.holds
    told = found.to_dict()
    assert (told["deaths"], told["lost"], told["recoveries"]) == (3, 3, 3)
    assert told["injected"] == {"kill": 3}
    assert (told["runs"], told["equal"], told["ended"]) == (1, 1, 0)


@pytest.mark.slow
def test_the_command_prints_and_writes_its_result(tmp_path: Path) -> None:
    words = ("verify", "nodes", "merge", "--nodes", "2", "--faults", "campaign")
    amount = ("--mix", "kill,damage", "--seeds", "2", "--process-runs", "1")
    path = tmp_path / "found.json"
    result = CliRunner().invoke(app, [*words, *amount, "--json", str(path)])
    assert result.exit_code == 0, result.output
    found = json.loads(path.read_text())
    assert found["holds"]
    assert found["simulated"]["injected"] == {"damage": 2, "kill": 2}
    assert found["processes"]["runs"] == len(FAULTS) + 1
    assert found["processes"]["deaths"] >= 35


@pytest.mark.parametrize(
    ("nodes", "keys", "words"),
    [
        ([0], {}, "must be one or more numbers from 1 on"),
        ([], {}, "must be one or more numbers from 1 on"),
        ([2], {"steps": 5}, "steps = 5"),
        ([2], {"faults": ["flood"]}, "must be among delay"),
    ],
)
def test_bad_input_is_refused(nodes: list[int], keys: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        verify_node_faults("merge", nodes, **keys)
