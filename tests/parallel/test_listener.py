"""A listener admits callers that know the secret, and disconnects other callers."""

from __future__ import annotations

import socket
import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest

import cavmarl.parallel.network.listener as listener_module
from cavmarl.core.errors import MessageError
from cavmarl.parallel.network.listener import MAGIC, VERSION, Listener, PendingConnection, call


class ListeningEnd:
    """The listening end: accepts one connection in a thread."""

    def __init__(self, busy_s: float = 0.0) -> None:
        self.secret = b"of this test"
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.setblocking(False)
        self.place: tuple[str, int] = self._server.getsockname()
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
                    caller = PendingConnection(self._server.accept()[0], self.secret)
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
        self._server.close()
        return self.found[0] if self.found else None


@pytest.mark.parametrize("busy_s", [0.0, 0.5])
def test_a_caller_with_the_secret_is_admitted(
    monkeypatch: pytest.MonkeyPatch, busy_s: float
) -> None:
    monkeypatch.setattr(listener_module, "CALL_S", 0.1)
    caller = ListeningEnd(busy_s)
    wire = call(caller.place, caller.secret, 5)
    number, connection = caller.join()
    assert number == 5
    wire.sendall(b"ready")
    connection.setblocking(True)
    assert connection.recv(16) == b"ready"
    wire.close()
    connection.close()


def test_a_listener_with_another_secret_is_refused() -> None:
    caller = ListeningEnd()
    with pytest.raises(MessageError, match="does not know the secret"):
        call(caller.place, b"another", 5)
    assert isinstance(caller.join(), EOFError)


@pytest.mark.parametrize(
    ("said", "error"),
    [
        (b"GET / HTTP/1.1\r\nHost: a\r\n\r\n", MessageError),
        (listener_module.HELLO.pack(MAGIC, VERSION + 1, 0, bytes(16)), MessageError),
        (listener_module.HELLO.pack(MAGIC, VERSION, 0, bytes(16)) + bytes(32), MessageError),
        (b"ca", EOFError),
    ],
)
def test_callers_with_invalid_bytes_are_refused(said: bytes, error: type[Exception]) -> None:
    caller = ListeningEnd()
    stranger = socket.create_connection(caller.place)
    stranger.sendall(said)
    stranger.shutdown(socket.SHUT_WR)
    assert isinstance(caller.join(), error)
    stranger.close()


def test_silent_callers_are_dropped_before_callers_that_have_sent_hello(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(listener_module, "MAX_CALLERS", 2)
    door = Listener("127.0.0.1", b"of this test")
    known, silent, third = (socket.create_connection(door.place) for _ in range(3))
    known.sendall(listener_module.HELLO.pack(MAGIC, VERSION, 0, bytes(16)))
    for _ in range(3):
        assert door.admit() == []
    known.settimeout(5.0)
    assert len(known.recv(48)) == 48, "the listener does not send its random number and its proof"
    silent.settimeout(5.0)
    assert silent.recv(1) == b"", "the listener does not disconnect the caller"
    for one in (known, third):
        one.setblocking(False)
        with pytest.raises(BlockingIOError):
            one.recv(1)
    for one in (known, silent, third):
        one.close()
    door.close()


def test_a_caller_has_five_seconds_for_each_part_of_the_handshake(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = SimpleNamespace(s=0.0)
    monkeypatch.setattr(listener_module, "time", SimpleNamespace(monotonic=lambda: now.s))
    door = Listener("127.0.0.1", b"of this test")
    known, silent = (socket.create_connection(door.place) for _ in range(2))
    door.admit()
    now.s = 4.0
    known.sendall(listener_module.HELLO.pack(MAGIC, VERSION, 0, bytes(16)))
    door.admit()
    assert len(known.recv(48)) == 48, "the listener does not send its random number and its proof"
    now.s = 8.0
    door.admit()
    assert silent.recv(1) == b"", "the listener does not disconnect the caller"
    known.setblocking(False)
    with pytest.raises(BlockingIOError):
        known.recv(1)
    now.s = 9.1
    door.admit()
    known.settimeout(5.0)
    assert known.recv(1) == b"", "the listener does not disconnect the caller"
    known.close()
    silent.close()
    door.close()


def test_a_call_to_a_closed_listener_is_an_error() -> None:
    door = Listener("127.0.0.1")
    door.close()
    with pytest.raises(OSError, match="refused"):
        call(door.place, door.secret, 0)
