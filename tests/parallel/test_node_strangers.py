"""Callers that do not belong to a run, or that the run does not need, over real sockets."""

from __future__ import annotations

import secrets
import socket
import sys
import threading
from contextlib import closing, suppress

import pytest

from cavmarl.core.errors import MessageError, MissingExtraError, NodeRefusedError
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.parallel.network.code_stamp import code_stamp
from cavmarl.parallel.network.listener import VERSION, Listener, call
from cavmarl.parallel.network.tcp_transport import TcpConnection, TcpListener
from cavmarl.parallel.nodes import joining_nodes
from cavmarl.parallel.nodes.joining_nodes import ANYONE, JoiningNodes
from cavmarl.parallel.nodes.link import FrameKind
from cavmarl.parallel.nodes.links import Links
from cavmarl.parallel.nodes.node_process import run_node
from cavmarl.parallel.nodes.peer_faults import LinkLostError
from tests.parallel.test_node_joining import WAIT_S, outside_address


class JoinServer:
    """The end to which nodes connect, in a thread."""

    def __init__(self, key: bytes, address: str = "127.0.0.1", room: int = 1) -> None:
        self.listener = TcpListener(address, key)
        self.joining_nodes = JoiningNodes(self.listener, {}, [], lambda: room, 1)
        self._is_open = True
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def _look(self) -> None:
        while self._is_open:
            self.joining_nodes.look(5.0)

    def close(self) -> None:
        self._is_open = False
        self._thread.join()
        self.joining_nodes.close()


def test_a_node_with_another_key_is_refused() -> None:
    for address in ("127.0.0.1", outside_address()):
        with closing(JoinServer(b"a" * 32, address)) as door:
            with pytest.raises(MessageError, match="give both the same key"):
                run_node(door.listener.place, b"b" * 32, ANYONE)


def answer(server: socket.socket, said: bytes) -> threading.Thread:
    """Start a thread that sends `said` to the first caller and ends."""

    def run() -> None:
        connection, _ = server.accept()
        with connection:
            connection.recv(1 << 16)
            connection.sendall(said)

    thread = threading.Thread(target=run)
    thread.start()
    return thread


def test_a_peer_without_encryption_is_refused() -> None:
    with closing(JoinServer(b"a" * 32, outside_address())) as door:
        with socket.create_connection(door.listener.place) as stranger:
            stranger.settimeout(5.0)
            stranger.sendall(secrets.token_bytes(100))
            with suppress(ConnectionResetError):
                assert b"cav" not in stranger.recv(100)
    with socket.create_server((outside_address(), 0)) as server:
        answering = answer(server, bytes(100))
        with pytest.raises(MessageError, match="does not use the encryption of cavmarl"):
            call(server.getsockname()[:2], b"a" * 32, ANYONE)
        answering.join()


def test_a_missing_library_for_encryption_is_an_error_at_the_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(MissingExtraError, match="nodes"):
        Listener(outside_address(), secrets.token_bytes(32))
    Listener("127.0.0.1").close()


def test_another_version_of_the_handshake_is_refused() -> None:
    with closing(JoinServer(b"a" * 32)) as door:
        with socket.create_connection(door.listener.place) as stranger:
            stranger.settimeout(5.0)
            stranger.sendall(b"cavW" + (VERSION + 1).to_bytes(2, "little") + bytes(20))
            assert stranger.recv(100) == b"cavW" + VERSION.to_bytes(2, "little")
    with socket.create_server(("127.0.0.1", 0)) as server:
        answering = answer(server, b"cavW\x63\x00")
        with pytest.raises(MessageError, match=f"version 99 of .*, this process has {VERSION}"):
            call(server.getsockname()[:2], b"a" * 32, ANYONE)
        answering.join()


@pytest.mark.parametrize(
    ("code", "room", "words"),
    [
        ("cavmarl of another day", 1, "runs cavmarl of another day.*install the same versions"),
        ("", 0, "no more nodes are needed"),
    ],
)
def test_nodes_with_other_code_and_superfluous_nodes_are_refused(
    monkeypatch: pytest.MonkeyPatch, code: str, room: int, words: str
) -> None:
    if code:
        monkeypatch.setattr(joining_nodes, "code_stamp", code_stamp)
        monkeypatch.setattr("cavmarl.parallel.nodes.node_process.code_stamp", lambda: code)
    with closing(JoinServer(b"a" * 32, room=room)) as door:
        with pytest.raises(NodeRefusedError, match=words):
            run_node(door.listener.place, b"a" * 32, ANYONE)


def test_an_admitted_caller_with_bad_frames_is_disconnected() -> None:
    with closing(JoinServer(b"a" * 32)) as door:
        for said in (b"no JSON", b"[]", b"{}"):
            links = Links(lambda number, frame: None)
            links.add(COORDINATOR, TcpConnection(call(door.listener.place, b"a" * 32, ANYONE)))
            links.send(COORDINATOR, FrameKind.JOIN, 0, [said])
            with pytest.raises(LinkLostError):
                links.receive([COORDINATOR], WAIT_S)
            links.close()
