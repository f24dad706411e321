"""Frames arrive as they were sent, or are refused; strangers get nothing."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cavmarl.parallel.network.listener as door_module
from cavmarl.core.errors import (
    MessageError,
)
from cavmarl.parallel.network.framed_socket import MAGIC, VERSION, FramedSocket, Kind
from cavmarl.parallel.network.listener import Listener, PendingConnection, knock

ARRAYS = [
    np.arange(12, dtype=np.float64).reshape(3, 4),
    np.zeros((0, 5), dtype=np.float32),
    np.array([True, False, True]),
    np.array([1 << 40], dtype=np.int64),
]


@pytest.fixture
def ends() -> Iterator[tuple[FramedSocket, FramedSocket]]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        first = FramedSocket(socket.create_connection(listener.getsockname()))
        connection, _ = listener.accept()
    connection.settimeout(2.0)
    second = FramedSocket(connection)
    yield first, second
    first.close()
    second.close()


def sent_bytes(**arguments: Any) -> bytes:
    """A frame as it goes over the wire."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        wire = FramedSocket(socket.create_connection(listener.getsockname()))
        other, _ = listener.accept()
        wire.send(Kind.DONE, 7, **arguments)
        wire.close()
        with other:
            return b"".join(iter(lambda: other.recv(1 << 16), b""))


def read(raw: bytes) -> tuple[Any, list[Any]]:
    """What somebody makes of these bytes."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        other = socket.create_connection(listener.getsockname())
        wire = FramedSocket(listener.accept()[0])
        with other:
            other.sendall(raw)
        try:
            frame = wire.receive()
            found = [np.zeros_like(array) for array in ARRAYS]
            wire.take(found)
        finally:
            wire.close()
    return frame, found


def test_a_frame_arrives_as_it_was_sent(ends: tuple[FramedSocket, FramedSocket]) -> None:
    near, far = ends
    near.send(Kind.DONE, 7, {"answer": [1, None]}, ARRAYS)
    near.send(Kind.BEAT, 8)
    frame = far.receive()
    assert far.is_torn
    found = [np.zeros_like(array) for array in ARRAYS]
    far.take(found)
    assert not far.is_torn
    assert frame[:3] == (Kind.DONE, 7, {"answer": [1, None]})
    assert all(np.array_equal(a, b) for a, b in zip(found, ARRAYS, strict=True))
    assert far.receive()[:3] == (Kind.BEAT, 8, None)
    far.skip()


def test_many_and_large_arrays(ends: tuple[FramedSocket, FramedSocket]) -> None:
    near, far = ends
    many = [np.full(3000, k, dtype=np.int64) for k in range(1200)]
    thread = threading.Thread(target=near.send, args=(Kind.ORDER, 1, None, many))
    thread.start()
    frame = far.receive()
    found = np.zeros((1200, 3000), dtype=np.int64)
    far.take([found])
    thread.join()
    assert frame.size == found.nbytes
    assert np.array_equal(found, many)


def test_every_changed_byte_is_noticed() -> None:
    whole = sent_bytes(payload={"answer": None}, arrays=ARRAYS)
    assert read(whole)[0].order == 7
    for at in range(len(whole)):
        changed = bytearray(whole)
        changed[at] ^= 0x10
        with pytest.raises((MessageError, EOFError)):
            read(bytes(changed))


@given(st.binary(max_size=200))
@settings(max_examples=50, deadline=None)
def test_garbage_is_refused(raw: bytes) -> None:
    with pytest.raises((MessageError, EOFError)):
        read(raw)


def test_a_frame_that_is_cut_short() -> None:
    whole = sent_bytes(arrays=ARRAYS)
    for size in range(0, len(whole), 7):
        with pytest.raises(EOFError):
            read(whole[:size])


def test_other_versions_and_sizes() -> None:
    whole = sent_bytes(arrays=ARRAYS)
    with pytest.raises(MessageError, match="version 9"):
        read(whole[:4] + b"\x09" + whole[5:])
    with pytest.raises(MessageError, match="is none"):
        read(whole[:16] + b"\xff" * 12 + whole[28:])
    with pytest.raises(MessageError, match="107 were to come"):
        read(sent_bytes(arrays=ARRAYS[:1]))


class Caller:
    """The caller's end: lets in whoever comes, in a thread."""

    def __init__(self, busy_s: float = 0.0) -> None:
        self.door = Listener("127.0.0.1")
        self.found: list[Any] = []
        self._busy_s = busy_s
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        caller: PendingConnection | None = None
        time.sleep(self._busy_s)
        until_s = time.monotonic() + 5.0
        while not self.found and time.monotonic() < until_s:
            time.sleep(0.005)
            try:
                if caller is None:
                    caller = PendingConnection(self.door._listener.accept()[0], self.door.secret)
                connection = caller.listen()
            except BlockingIOError:
                continue
            except (MessageError, OSError, EOFError) as error:
                self.found.append(error)
                caller and caller.close()
                return
            if caller and connection:
                self.found.append((caller.number, connection))

    def join(self) -> Any:
        self._thread.join()
        self.door.close()
        return self.found[0] if self.found else None


@pytest.mark.parametrize("busy_s", [0.0, 0.5])
def test_who_knows_the_secret_comes_in(monkeypatch: pytest.MonkeyPatch, busy_s: float) -> None:
    monkeypatch.setattr(door_module, "CALL_S", 0.1)
    caller = Caller(busy_s)
    wire = knock(caller.door.place, caller.door.secret, 5)
    number, connection = caller.join()
    assert number == 5
    wire.send(Kind.READY, 0)
    connection.setblocking(True)
    other = FramedSocket(connection)
    assert other.receive().kind == Kind.READY
    wire.close()
    other.close()


def test_a_caller_who_does_not_know_the_secret_is_not_obeyed() -> None:
    caller = Caller()
    with pytest.raises(MessageError, match="does not know the secret"):
        knock(caller.door.place, b"another", 5)
    assert isinstance(caller.join(), EOFError)


@pytest.mark.parametrize(
    ("said", "error"),
    [
        (b"GET / HTTP/1.1\r\nHost: a\r\n\r\n", MessageError),
        (door_module._HELLO.pack(MAGIC, VERSION + 1, 0, bytes(16)), MessageError),
        (door_module._HELLO.pack(MAGIC, VERSION, 0, bytes(16)) + bytes(32), MessageError),
        (b"ca", EOFError),
    ],
)
def test_strangers_stay_outside(said: bytes, error: type[Exception]) -> None:
    caller = Caller()
    stranger = socket.create_connection(caller.door.place)
    stranger.sendall(said)
    stranger.shutdown(socket.SHUT_WR)
    assert isinstance(caller.join(), error)
    stranger.close()


def test_nobody_is_there() -> None:
    door = Listener("127.0.0.1")
    door.close()
    with pytest.raises(OSError, match="refused"):
        knock(door.place, door.secret, 0)
