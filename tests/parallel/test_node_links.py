"""Frames between nodes: their bytes, invalid frames, and frames that a node must not send."""

from __future__ import annotations

import json
import socket
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import numpy as np
import pytest
from xxhash import xxh3_64_intdigest

from cavmarl.core.errors import MessageError
from cavmarl.ownership.decisions import Neighbours
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import COORDINATOR, Done
from cavmarl.parallel.network.encryption import encrypted
from cavmarl.parallel.network.tcp_transport import TcpConnection
from cavmarl.parallel.network.transport import READS
from cavmarl.parallel.nodes.link import MAX_FRAME, FrameKind, NodeFrame, read_list
from cavmarl.parallel.nodes.links import Links, SilenceError
from cavmarl.parallel.nodes.node_coordinator import NodeCoordinator
from cavmarl.parallel.nodes.node_handshake import accept_nodes, call_node
from cavmarl.parallel.nodes.node_system import MACHINE
from cavmarl.parallel.nodes.node_watch import NodeWatch, Pong, SilentNodeError
from cavmarl.parallel.nodes.peer_faults import LinkLostError
from cavmarl.parallel.nodes.zone_endpoints import Report, packed
from tests.parallel.test_node_joining import WAIT_S


def pair() -> tuple[Links, socket.socket]:
    near, far = socket.socketpair()
    links = Links(lambda number, frame: None)
    links.add(0, TcpConnection(near))
    return links, far


def frame(kind: FrameKind, data: bytes | memoryview) -> bytes:
    links, far = pair()
    links.send(0, kind, 7, [data])
    with far:
        said = far.recv(1 << 16)
    links.close()
    return said


def head(kind: int, size: int) -> bytes:
    """Return the head of the first frame on a connection."""
    found = b"cavN\x07\x00" + kind.to_bytes(2, "little") + bytes(8) + size.to_bytes(8, "little")
    found += bytes(8)
    return found + xxh3_64_intdigest(found, 1).to_bytes(8, "little")


def test_a_frame_has_the_recorded_bytes() -> None:
    assert frame(FrameKind.PING, b"abc").hex() == (
        "6361764e07000d000700000000000000" + "0300000000000000" + "50392f89945faf78"
        "30bc61f204c45035" + b"abc".hex()
    )


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (b"GET / HTTP/1.1\r\n" * 9, "does not start a frame"),
        (head(FrameKind.PING, MAX_FRAME + 1), f"more than {MAX_FRAME}"),
        (b"cavN\x09\x00" + bytes(34), "version 9"),
        (head(255, 0), "kind 255"),
        (frame(FrameKind.PING, b"abc")[:-1] + b"d", "are damaged"),
        (2 * frame(FrameKind.SYNC, b"abc"), "out of order"),
        (frame(FrameKind.SYNC, b"abc")[:-1], "has ended"),
    ],
)
def test_a_bad_frame_ends_the_connection(said: bytes, words: str) -> None:
    links, far = pair()
    far.sendall(said)
    far.close()
    with pytest.raises(LinkLostError, match=words):
        _ = [links.receive([0], WAIT_S) for _ in range(3)]


def test_a_node_that_sends_for_a_zone_of_another_node_is_disconnected() -> None:
    links, far = pair()
    coordinator = NodeCoordinator([bytes(16)], [0, 0, 1], Limits(), links, [None])
    coordinator.host(Neighbours((frozenset((1,)), frozenset((0, 2)), frozenset((1,)))))
    links.urgent = coordinator.receive
    table = coordinator.worlds[0].directory.table
    done = {
        zone: Done(bytes(16), table.episode, table.tick, zone=zone, incarnation=1)
        for zone in (1, 2, 9)
    }
    coordinator.check(0, [(0, done[1])])
    coordinator.check(1, [(0, done[2])])
    for number, zone in ((0, 2), (1, 1), (0, 9)):
        with pytest.raises(MessageError, match=f"node {number} sends for zone {zone}"):
            coordinator.check(number, [(0, done[zone])])
    others, theirs = pair()
    others.send(0, FrameKind.MESSAGES, 0, [packed([(0, done[2])])])
    with far, theirs:
        far.sendall(theirs.recv(1 << 16))
        with pytest.raises(LinkLostError, match="sends for zone 2"):
            links.pump(1000.0)
    others.close()


@pytest.mark.parametrize(("size", "bits"), [(3, None), (9999, 99)])
def test_a_frame_with_any_changed_bit_ends_the_connection(size: int, bits: int | None) -> None:
    """Check also that the receiver does not wait for more bytes."""
    drawn = np.random.default_rng(size)
    sent = frame(FrameKind.SYNC, drawn.bytes(size))
    every = 8 * len(sent)
    for bit in range(every) if bits is None else drawn.integers(every, size=bits).tolist():
        changed = bytearray(sent)
        changed[bit // 8] ^= 1 << bit % 8
        links, far = pair()
        far.sendall(changed)
        with pytest.raises(LinkLostError, match="frame"):
            links.receive([0], WAIT_S)
        far.close()


def test_an_array_of_words_is_sent_as_its_bytes() -> None:
    words = np.arange(3)
    assert frame(FrameKind.SYNC, words.data)[-24:] == words.tobytes()


@pytest.mark.parametrize("is_encrypted", [False, True])
def test_bytes_that_the_socket_does_not_accept_at_once_are_sent_later(is_encrypted: bool) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        ends = socket.create_connection(server.getsockname()), server.accept()[0]
    if is_encrypted:
        with ThreadPoolExecutor() as pool:
            called = pool.submit(encrypted, ends[0], b"secret", calls=True)
            there = encrypted(ends[1], b"secret", calls=False)
            there.do_handshake()
            ends = called.result(), there
    near, far = (Links(lambda number, frame: None) for _ in ends)
    near.add(0, TcpConnection(ends[0]))
    far.add(0, TcpConnection(ends[1]))
    parts = np.random.default_rng(0).integers(256, size=(3, 3 << 20), dtype=np.uint8)
    for part in parts:
        near.send(0, FrameKind.SHARE, 1, [part[:7].data, part[7:].data])
        near.send(0, FrameKind.SYNC, 2, [b"small"])
    alone = parts[0, :-1].copy()
    near.send(0, FrameKind.SHARE, 3, [alone.data])
    alone[:] = 0  # the sender reuses its memory before the bytes are sent
    with ThreadPoolExecutor() as pool:
        flushed = pool.submit(near.flush)
        for part in parts:
            assert far.receive_next(0).data == part.data
            assert far.receive_next(0).data == b"small"
        assert far.receive_next(0).data == parts[0, :-1].data
        flushed.result()
    near.close()
    far.close()


@pytest.mark.parametrize("said", [b"no JSON", b"{}", b"\xff"])
def test_a_frame_without_a_list_is_refused(said: bytes) -> None:
    with pytest.raises(MessageError, match="a frame of kind PONG: it"):
        read_list(NodeFrame(FrameKind.PONG, 1, memoryview(said)))


def test_connections_probe_silent_machines() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        connection = socket.create_connection(server.getsockname())
    links = Links(lambda number, frame: None)
    links.add(0, TcpConnection(connection))
    asked_s = sum(
        connection.getsockopt(socket.IPPROTO_TCP, option) * times
        for option, times in ((socket.TCP_KEEPIDLE, 1), (socket.TCP_KEEPINTVL, 3))
    )
    assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
    assert asked_s <= 25
    links.close()


def test_a_call_of_an_earlier_generation_is_rejected() -> None:
    listener = MACHINE.listen("127.0.0.1", b"secret")

    def call(generation: int) -> int:
        """Return the number of bytes received before the connection ends, at most 1."""
        room = memoryview(bytearray(1))
        with closing(call_node(MACHINE, listener.place, b"secret", 2, generation, of=1)) as found:
            poll = MACHINE.poll()
            poll.register(found, READS)
            while not (got := found.receive(room)) and not found.closed:
                poll.poll(None)
        return got

    with closing(listener), ThreadPoolExecutor() as callers:
        earlier = callers.submit(call, 6)
        (found,) = accept_nodes(MACHINE, listener, [2], 6, WAIT_S, lambda: None).values()
        found.close()  # the first attempt to start the nodes fails
        assert earlier.result() == 0
        earlier = callers.submit(call, 6)
        present: list[object] = []

        def check() -> None:
            if earlier.done() and not present:
                present.append(callers.submit(call, 7))

        found_now = accept_nodes(MACHINE, listener, [2], 7, WAIT_S, check)
        assert earlier.result() == 0
        assert list(found_now) == [2]
        found_now[2].close()
        with pytest.raises(LinkLostError, match="node 3"):
            accept_nodes(MACHINE, listener, [3], 7, 0.0, lambda: None)


def watch(links: Links) -> NodeWatch:
    return NodeWatch(links, set, lambda agent: [0, 1][agent])


def test_the_sender_of_a_bad_frame_is_lost_but_not_the_receiver() -> None:
    links, far = pair()
    with far:
        seen = watch(links)
        for number, peer, fault in ((2, 0, ""), (0, 2, "it is late"), (1, 0, "")):
            with pytest.raises(LinkLostError, match=f"node {peer}"):
                seen.report_missed(number, peer, fault)
        lost = seen.most_missed(LinkLostError(0), 0)
        assert (lost.peer, lost.fault) == (2, "node 0 reports: it is late")
    links.close()


def test_two_nodes_that_cannot_reach_each_other_are_lost_in_turn() -> None:
    """Either may be at fault, so the lost node alternates with the number of changes of nodes."""
    links, far = pair()
    with far:
        found = []
        for generation in range(4):
            seen = watch(links)
            with pytest.raises(LinkLostError):
                seen.report_missed(3, 0, "")
            found.append(seen.most_missed(LinkLostError(0), generation).peer)
    links.close()
    assert found == [3, 0, 3, 0]


def test_a_node_that_does_not_return_an_action_of_another_node_is_lost() -> None:
    """A node waits for an action of its agent that went to another node and was not returned."""
    links, far = pair()
    seen = watch(links)

    def answer(number: int, frame: NodeFrame) -> None:
        seen.receive_pong(number, frame)

    def wait(left_s: float) -> None:
        raise SilenceError("nothing comes")

    links.urgent = answer
    others = Links(lambda number, frame: None)
    others.add(0, TcpConnection(far))
    pong = Pong([COORDINATOR], [], [], [0])
    others.send(0, FrameKind.PONG, 1, [json.dumps(pong).encode()])
    with pytest.raises(SilentNodeError, match="it has not refused foreign actions") as lost:
        seen.wait([0], 0.0, wait)
    assert lost.value.peer == 0
    others.send(0, FrameKind.PONG, 1, [json.dumps(pong._replace(agents=[2])).encode()])
    with pytest.raises(LinkLostError, match="cannot be read: IndexError"):
        links.pump(1000.0)
    others.close()


def test_a_node_that_reports_late_twice_in_a_row_is_lost() -> None:
    """After a late report, a lease of no ticks lets all nodes report their new vehicles."""
    links, far = pair()
    coordinator = NodeCoordinator([bytes(16)], [0, 1], Limits(), links, [None])
    coordinator.host(Neighbours((frozenset((1,)), frozenset((0,)))))
    late = Report([], [], False, [], is_late=True)
    for _ in range(2):
        coordinator.commit({0: ([], []), 1: ([], [late])})
        assert coordinator.is_late
        coordinator.commit({0: ([], []), 1: ([], [])})
        assert not coordinator.is_late
    coordinator.commit({0: ([], []), 1: ([], [late])})
    with pytest.raises(LinkLostError, match="it has not reported new vehicles") as lost:
        coordinator.commit({0: ([], []), 1: ([], [late])})
    assert lost.value.peer == 1
    far.close()
    links.close()
