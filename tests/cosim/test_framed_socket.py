"""Frames arrive as they were sent, or are refused."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from enum import IntEnum
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavmarl.core.errors import MessageError
from cavmarl.cosim.followers.framed_socket import Dialect, FramedSocket


class Kind(IntEnum):
    """Kinds of frames in these tests."""

    COMMAND = 0
    DONE = 1
    HEARTBEAT = 2


DIALECT = Dialect(
    b"test", 1, Kind, 1 << 17, 1 << 34, lambda payload: json.dumps(payload).encode(), json.loads,
    "use one version",
)  # fmt: skip

ARRAYS = [
    np.arange(12, dtype=np.float64).reshape(3, 4),
    np.zeros((0, 5), dtype=np.float32),
    np.array([True, False, True]),
    np.array([1 << 40], dtype=np.int64),
]


@pytest.fixture
def ends() -> Iterator[tuple[FramedSocket, FramedSocket]]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        first = FramedSocket(socket.create_connection(listener.getsockname()), DIALECT)
        connection, _ = listener.accept()
    connection.settimeout(2.0)
    second = FramedSocket(connection, DIALECT)
    yield first, second
    first.close()
    second.close()


def sent_bytes(**arguments: Any) -> bytes:
    """Return the bytes that a frame has on the connection."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        wire = FramedSocket(socket.create_connection(listener.getsockname()), DIALECT)
        other, _ = listener.accept()
        wire.send(Kind.DONE, 7, **arguments)
        wire.close()
        with other:
            return b"".join(iter(lambda: other.recv(1 << 16), b""))


def read(raw: bytes) -> tuple[Any, list[Any]]:
    """Send these bytes to a `FramedSocket`, and return the frame and the arrays that it reads."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        other = socket.create_connection(listener.getsockname())
        wire = FramedSocket(listener.accept()[0], DIALECT)
        with other:
            other.sendall(raw)
        try:
            frame = wire.receive()
            found = [np.zeros_like(array) for array in ARRAYS]
            wire.take(found)
        finally:
            wire.close()
    return frame, found


def test_received_frames_equal_sent_frames(ends: tuple[FramedSocket, FramedSocket]) -> None:
    near, far = ends
    near.send(Kind.DONE, 7, {"answer": [1, None]}, ARRAYS)
    near.send(Kind.HEARTBEAT, 8)
    frame = far.receive()
    found = [np.zeros_like(array) for array in ARRAYS]
    far.take(found)
    assert frame[:3] == (Kind.DONE, 7, {"answer": [1, None]})
    assert all(np.array_equal(a, b) for a, b in zip(found, ARRAYS, strict=True))
    assert far.receive()[:3] == (Kind.HEARTBEAT, 8, None)
    far.skip()


def test_many_large_arrays_are_received_unchanged(ends: tuple[FramedSocket, FramedSocket]) -> None:
    near, far = ends
    many = [np.full(3000, k, dtype=np.int64) for k in range(1200)]
    thread = threading.Thread(target=near.send, args=(Kind.COMMAND, 1, None, many))
    thread.start()
    frame = far.receive()
    found = np.zeros((1200, 3000), dtype=np.int64)
    far.take([found])
    thread.join()
    assert frame.size == found.nbytes
    assert np.array_equal(found, many)


def test_a_frame_with_any_changed_byte_is_refused() -> None:
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


def test_a_truncated_frame_is_refused() -> None:
    whole = sent_bytes(arrays=ARRAYS)
    for size in range(0, len(whole), 7):
        with pytest.raises(EOFError):
            read(whole[:size])


def test_frames_of_other_versions_or_sizes_are_refused() -> None:
    whole = sent_bytes(arrays=ARRAYS)
    with pytest.raises(MessageError, match="version 9"):
        read(whole[:4] + b"\x09" + whole[5:])
    with pytest.raises(MessageError, match="is too large"):
        read(whole[:16] + b"\xff" * 12 + whole[28:])
    with pytest.raises(MessageError, match="107 are expected"):
        read(sent_bytes(arrays=ARRAYS[:1]))
