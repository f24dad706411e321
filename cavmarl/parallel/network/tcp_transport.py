"""`TcpTransport`: connections over TCP, encrypted by TLS where they leave this machine."""

from __future__ import annotations

import select
import socket
from collections.abc import Sequence

from cavmarl.parallel.network.encryption import EncryptedSocket
from cavmarl.parallel.network.listener import Listener, call
from cavmarl.parallel.network.transport import (
    Bytes,
    Connection,
    Place,
    TransportListener,
    TransportPoll,
)

# A machine that vanishes sends nothing, so the system probes a silent connection.
_ALIVE = [(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)] + [
    (socket.IPPROTO_TCP, getattr(socket, name), value)
    for name, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 3))
    if hasattr(socket, name)
]


class TcpConnection:
    """A `Connection` over a socket, which it owns."""

    def __init__(self, connection: socket.socket) -> None:
        if connection.family != socket.AF_UNIX:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for level, option, value in _ALIVE:
                connection.setsockopt(level, option, value)
        connection.setblocking(False)
        self._socket = connection
        self.keeps_bytes = isinstance(connection, EncryptedSocket)
        self.closed = False

    @property
    def address(self) -> str:
        return str(self._socket.getsockname()[0])

    def send(self, pieces: Sequence[Bytes]) -> int:
        try:
            return self._socket.sendmsg(pieces)
        except BlockingIOError:
            return 0

    def receive(self, room: memoryview) -> int:
        try:
            got = self._socket.recv_into(room)
        except BlockingIOError:
            return 0
        if not got:
            self.closed = True
        return got

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


class TcpListener:
    """A `TransportListener` for callers that know the secret."""

    def __init__(
        self,
        address: str,
        secret: bytes | None = None,  # None: a random secret
        port: int = 0,  # 0: the system chooses
    ) -> None:
        self._listener = Listener(address, secret, port)
        self.place, self.secret = self._listener.place, self._listener.secret

    def fileno(self) -> int:
        return self._listener.fileno()

    def admit(self) -> list[tuple[int, Connection]]:
        return [(number, TcpConnection(one)) for number, one in self._listener.admit()]

    def close(self) -> None:
        self._listener.close()


class TcpTransport:
    """A `Transport` over sockets."""

    def open(self, place: Place, secret: bytes, number: int, answer_s: float | None) -> Connection:
        return TcpConnection(call(place, secret, number, answer_s))

    def listen(self, address: str, secret: bytes) -> TransportListener:
        return TcpListener(address, secret)

    def poll(self) -> TransportPoll:
        return select.poll()
