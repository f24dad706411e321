"""The viewer limits partial and endless requests, and data after a request."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack

import httpx
import pytest

from cavmarl.core import request_heads
from cavmarl.viewer.web_options import WebOptions
from cavmarl.viewer.web_server import MOST_WATCHERS, WebServer

HEAD_S = 1.0


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[WebServer]:
    monkeypatch.setattr(request_heads, "HEAD_S", HEAD_S)
    with WebServer(WebOptions(port=0), []) as running:
        yield running


def connection(server: WebServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.port), timeout=20.0)


def is_closed_by_server(peer: socket.socket) -> bool:
    """Read until the server closes the connection; False if it does not."""
    try:
        while peer.recv(65536):
            pass
    except TimeoutError:
        return False
    except ConnectionError:
        pass
    return True


def head(server: WebServer, *fields: str) -> bytes:
    lines = ["GET /icon.svg HTTP/1.1", f"Host: 127.0.0.1:{server.port}", *fields]
    return "".join(f"{line}\r\n" for line in lines).encode()


def test_partial_heads_do_not_block_other_clients_for_long(server: WebServer) -> None:
    with ExitStack() as stack:
        peers = [stack.enter_context(connection(server)) for _ in range(2 * MOST_WATCHERS + 20)]
        for peer in peers:
            peer.sendall(b"GET / HTTP/1.1\r\nX-Slow: ")
        assert all(map(is_closed_by_server, peers))
        assert httpx.get(server.address).status_code == 200


def test_an_endless_head_ends_the_connection(server: WebServer) -> None:
    with connection(server) as peer, pytest.raises(ConnectionError):
        peer.sendall(head(server) + b"X-Long: " + b"a" * 2**26)
    assert httpx.get(server.address).status_code == 200


@pytest.mark.parametrize("rest", [b"\r\n", b"GET / HTTP/1.1\r\nX-Slow: "])
def test_a_connection_is_closed_after_its_answer(server: WebServer, rest: bytes) -> None:
    with connection(server) as peer:
        peer.sendall(head(server) + b"\r\n")
        assert b" 200 " in peer.recv(65536)
        peer.sendall(rest)
        assert is_closed_by_server(peer)


def test_a_connection_with_an_incomplete_body_is_closed(server: WebServer) -> None:
    with connection(server) as peer:
        peer.sendall(head(server, "Content-Length: 100") + b"\r\n")
        assert b" 200 " in peer.recv(65536)
        peer.sendall(b"half")
        assert is_closed_by_server(peer)


def test_endless_trailers_end_the_connection(server: WebServer) -> None:
    with connection(server) as peer:
        peer.sendall(head(server, "Transfer-Encoding: chunked") + b"\r\n0\r\n")
        with pytest.raises(ConnectionError):
            peer.sendall(b"X-Trailer: " + b"a" * 2**26)


def test_a_long_body_and_a_second_request_are_accepted(server: WebServer) -> None:
    with httpx.Client() as client:
        for content in (b"x" * 2**20, (b"x" * 1000 for _ in range(1000))):
            answer = client.request("GET", f"{server.address}icon.svg", content=content)
            assert answer.status_code == 200
        time.sleep(0.1)
        assert client.get(server.address).status_code == 200
