"""Accepts hosts: only processes that know the secret get in.

The caller listens on one port, and hosts call there; they listen nowhere. Both prove that they know
the secret, which Ray has handed to the host, without sending it: each answers the other's random
number with its HMAC. Until that is done nothing else is read, and no more than a few bytes.

    host → caller   HELLO: magic, version, number of the host, random number
    caller → host   random number, proof
    host → caller   proof
"""

from __future__ import annotations

import hmac
import secrets
import socket
import struct
import time

from cavmarl.core.errors import MessageError, WorkerError
from cavmarl.parallel.hosts.framed_socket import MAGIC, VERSION, FramedSocket

NONCE = 16  # bytes of a random number
PROOF = 32  # of an HMAC
SECRET = 32
GREETING_S = 5.0  # for a guest to prove its identity
CALL_S = 5.0  # for the system to connect
MAX_GUESTS = 64  # not authenticated yet
BACKLOG = 1024  # callers that the system holds until they are accepted
_HELLO = struct.Struct(f"<4sHI{NONCE}s")


class PendingConnection:
    """A caller that has not proved its identity yet."""

    def __init__(self, connection: socket.socket, secret: bytes) -> None:
        connection.setblocking(False)
        self.until_s = time.monotonic() + GREETING_S  # for so long it may take, by `time.monotonic`
        self.number = -1  # that it says it has; -1: it has said nothing
        self._socket = connection
        self._secret = secret
        self._heard = b""
        self._expected = b""

    def fileno(self) -> int:
        return self._socket.fileno()

    def listen(self) -> socket.socket | None:
        """Take what it has said; its connection, once it has proved that it knows the secret.

        Raises:
            OSError: it is gone.
        """
        wanted = PROOF if self._expected else _HELLO.size
        try:
            heard = self._socket.recv(wanted - len(self._heard))
        except BlockingIOError:
            return None
        if not heard:
            raise EOFError("the connection has ended")
        self._heard += heard
        if len(self._heard) < wanted:
            return None
        said, self._heard = self._heard, b""
        if not self._expected:
            self._answer(said)
            return None
        if not hmac.compare_digest(said, self._expected):
            raise MessageError("somebody who does not know the secret has called")
        return self._socket

    def close(self) -> None:
        self._socket.close()

    def _answer(self, hello: bytes) -> None:
        magic, version, self.number, _ = _HELLO.unpack(hello)
        if magic != MAGIC:
            raise MessageError(f"somebody who says {hello[:4]!r} has called")
        if version != VERSION:
            raise MessageError(
                f"host {self.number} speaks version {version}, this is {VERSION}: install the same "
                "cavmarl on all machines"
            )
        ours = secrets.token_bytes(NONCE)
        self._expected = _proof(self._secret, b"host", hello + ours)
        self._socket.sendall(ours + _proof(self._secret, b"caller", hello + ours))


class Listener:
    """Listens."""

    def __init__(self, address: str, secret: bytes | None = None) -> None:
        # that hosts have to know; None: one is drawn
        self.secret = secrets.token_bytes(SECRET) if secret is None else secret
        try:
            self._listener = socket.create_server((address, 0), backlog=BACKLOG)
        except OSError as error:
            raise WorkerError(f"cannot listen on {address}: {error}") from error
        self._listener.setblocking(False)
        self.place: tuple[str, int] = self._listener.getsockname()[:2]  # address and port

    def fileno(self) -> int:
        return self._listener.fileno()

    def open(self) -> PendingConnection | None:
        """Accept a caller; None: there is none any more."""
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return None
        return PendingConnection(connection, self.secret)

    def close(self) -> None:
        self._listener.close()


def knock(place: tuple[str, int], secret: bytes, number: int) -> FramedSocket:
    """Call as a host; the caller may be busy for long before it answers.

    Raises:
        OSError: nobody listens there.
    """
    return FramedSocket(call(place, secret, number))


def call(place: tuple[str, int], secret: bytes, number: int) -> socket.socket:
    """A connection to a `Listener` on which both ends have proved that they know the secret.

    Raises:
        OSError: nothing listens there.
        MessageError: what listens there does not know the secret.
    """
    connection = socket.create_connection(place, CALL_S)
    try:
        connection.settimeout(None)
        hello = _HELLO.pack(MAGIC, VERSION, number, secrets.token_bytes(NONCE))
        connection.sendall(hello)
        heard = b""
        while len(heard) < NONCE + PROOF:
            more = connection.recv(NONCE + PROOF - len(heard))
            if not more:
                raise EOFError(f"the process that listens at {place} has ended the connection")
            heard += more
        nonce, proof = heard[:NONCE], heard[NONCE:]
        if not hmac.compare_digest(proof, _proof(secret, b"caller", hello + nonce)):
            raise MessageError(f"who listens at {place} does not know the secret")
        connection.sendall(_proof(secret, b"host", hello + nonce))
    except BaseException:
        connection.close()
        raise
    return connection


def _proof(secret: bytes, who: bytes, said: bytes) -> bytes:
    return hmac.digest(secret, who + said, "sha256")
