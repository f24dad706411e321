"""Accepts hosts and nodes: only processes that know the secret get in.

One process listens, and others call there. Both prove that they know the secret without sending
it: each answers the other's random number with its HMAC. Until that is done nothing else is read,
and no more than a few bytes. What leaves this machine is encrypted before.

    host → caller   HELLO: magic, version, number of the host, random number
    caller → host   random number, proof
    host → caller   proof

A caller of another version is told which one is spoken here.
"""

from __future__ import annotations

import errno
import hmac
import secrets
import selectors
import socket
import ssl
import struct
import time
from collections.abc import Iterator
from contextlib import suppress

from cavmarl.core.errors import MessageError, WorkerError
from cavmarl.parallel.network.encryption import (
    EncryptedSocket,
    encrypted,
    leaves_this_machine,
    prepare,
)

MAGIC = b"cavW"
VERSION = 1  # of this handshake
NONCE = 16  # bytes of a random number
PROOF = 32  # of an HMAC
SECRET = 32
GREETING_S = 5.0  # for a caller to prove its identity
CALL_S = 5.0  # for the system to connect
MAX_CALLERS = 64  # not authenticated yet
BACKLOG = 1024  # callers that the system holds until they are accepted
NO_DESCRIPTORS_S = 0.05  # until the next attempt to have a descriptor
_SPOKEN = struct.Struct("<4sH")
_HELLO = struct.Struct(f"<4sHI{NONCE}s")


class PendingConnection:
    """A caller that has not proved its identity yet."""

    def __init__(self, connection: socket.socket, secret: bytes) -> None:
        connection.setblocking(False)
        self.until_s = time.monotonic() + GREETING_S  # for so long it may take, by `time.monotonic`
        self.number = -1  # that it says it has; -1: it has data nothing
        self._socket = connection
        if leaves_this_machine(connection):
            self._socket = encrypted(connection, secret, calls=False)
        self._secret = secret
        self._received = b""
        self._expected = b""

    def fileno(self) -> int:
        return self._socket.fileno()

    def listen(self) -> socket.socket | None:
        """Take what it has data; its connection, once it has proved that it knows the secret.

        Raises:
            OSError: it is gone.
        """
        if isinstance(self._socket, EncryptedSocket) and self._socket.version() is None:
            try:
                self._socket.do_handshake()
            except (ssl.SSLWantReadError, ssl.SSLWantWriteError):
                return None
            self._go_on()
        wanted = PROOF if self._expected else _HELLO.size
        try:
            received = self._socket.recv(wanted - len(self._received))
        except BlockingIOError:
            return None
        if not received:
            raise EOFError("the connection has ended")
        self._received += received
        if len(self._received) < wanted:
            return None
        data, self._received = self._received, b""
        if not self._expected:
            self._answer(data)
            self._go_on()
            return None
        if not hmac.compare_digest(data, self._expected):
            raise MessageError("a caller does not know the secret")
        return self._socket

    def close(self) -> None:
        self._socket.close()

    def _go_on(self) -> None:
        """It may take as long again: the listener may be busy in between."""
        self.until_s = time.monotonic() + GREETING_S

    def _answer(self, hello: bytes) -> None:
        magic, version, self.number, _ = _HELLO.unpack(hello)
        if magic != MAGIC:
            raise MessageError(f"a caller says {hello[:4]!r}")
        if version != VERSION:
            self._socket.sendall(_SPOKEN.pack(MAGIC, VERSION))
            raise MessageError(
                f"host {self.number} speaks version {version}, this is {VERSION}: install the same "
                "cavmarl on all machines"
            )
        ours = secrets.token_bytes(NONCE)
        self._expected = _proof(self._secret, b"host", hello + ours)
        self._socket.sendall(ours + _proof(self._secret, b"caller", hello + ours))


class Listener:
    """Lets in callers that know the secret; strangers cost little and are disconnected.

    Raises:
        WorkerError: the port cannot be listened on.
        MissingExtraError: others than this machine can call there, and cryptography is missing.
    """

    def __init__(
        self,
        address: str,
        secret: bytes | None = None,  # that callers have to know; None: one is drawn
        port: int = 0,  # 0: the system chooses
    ) -> None:
        self.secret = secrets.token_bytes(SECRET) if secret is None else secret
        try:
            self._listener = socket.create_server((address, port), backlog=BACKLOG)
        except (OSError, OverflowError) as error:
            where = f"{address}:{port}" if port else address
            raise WorkerError(
                f"cannot listen on {where}: {error}; name an address of this machine, and a port "
                "that no other program has"
            ) from error
        self._listener.setblocking(False)
        self.place: tuple[str, int] = self._listener.getsockname()[:2]  # address and port
        try:
            prepare(self.place[0], self.secret)
        except BaseException:
            self._listener.close()
            raise
        self._callers: list[PendingConnection] = []
        self._spare = socket.socket()  # a descriptor for a caller that is hung up on
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)

    def fileno(self) -> int:
        """Readable when there is something to `admit`."""
        return self._selector.fileno()

    def admit(self) -> list[tuple[int, socket.socket]]:
        """Hear all callers, without waiting.

        Returns:
            callers that have proved that they know the secret: the number that each says, its
                connection.
        """
        admitted: list[tuple[int, socket.socket]] = []
        for key, _ in self._selector.select(0.0):
            if key.fileobj is self._listener:
                for caller in self._welcome():
                    self._listen(caller, admitted)
            elif key.fileobj in self._callers:  # not disconnected meanwhile
                self._listen(key.fileobj, admitted)
        now = time.monotonic()
        for caller in [caller for caller in self._callers if caller.until_s < now]:
            self._disconnect(caller)
        return admitted

    def _welcome(self) -> Iterator[PendingConnection]:
        """Accept all that call; where they are too many, the silent ones leave first."""
        for _ in range(MAX_CALLERS):
            try:
                connection, _ = self._listener.accept()
            except OSError as error:
                if error.errno not in (errno.EMFILE, errno.ENFILE):
                    return
                self._find_descriptor()
                continue
            if len(self._callers) == MAX_CALLERS:
                self._disconnect_the_first()
            try:
                caller = PendingConnection(connection, self.secret)
            except OSError:  # it is gone already
                connection.close()
                continue
            self._callers.append(caller)
            self._selector.register(caller, selectors.EVENT_READ)
            yield caller

    def _listen(self, caller: PendingConnection, admitted: list[tuple[int, socket.socket]]) -> None:
        try:
            connection = caller.listen()
        except (EOFError, OSError, MessageError):  # a stranger: ignored
            self._disconnect(caller)
            return
        if connection is not None:
            self._callers.remove(caller)
            self._selector.unregister(caller)
            admitted.append((caller.number, connection))

    def _find_descriptor(self) -> None:
        """This process has none left: the next caller gets that of another one, or is hung up on.

        If it were left to wait, the listener would wake this process again at once.
        """
        if self._callers:
            self._disconnect_the_first()
            return
        self._spare.close()
        with suppress(OSError):
            self._listener.accept()[0].close()
        try:
            self._spare = socket.socket()
        except OSError:  # a thread has taken it meanwhile
            time.sleep(NO_DESCRIPTORS_S)

    def _disconnect_the_first(self) -> None:
        """Of the silent ones that which has waited longest; where all have spoken, of all."""
        self._disconnect(min(self._callers, key=lambda each: (each.number >= 0, each.until_s)))

    def _disconnect(self, caller: PendingConnection) -> None:
        self._callers.remove(caller)
        self._selector.unregister(caller)
        caller.close()

    def close(self) -> None:
        self._selector.close()
        self._spare.close()
        for caller in self._callers:
            caller.close()
        self._listener.close()


def call(
    place: tuple[str, int],
    secret: bytes,
    number: int,
    answer_s: float | None = None,  # for the listener to answer; None: as long as it takes
) -> socket.socket:
    """A connection to a `Listener` on which both ends have proved that they know the secret.

    Raises:
        OSError: nothing listens there.
        EOFError: the listener wants no more callers.
        MessageError: it does not know the secret, or speaks another version.
    """
    connection = socket.create_connection(place, CALL_S)
    try:
        connection.settimeout(answer_s)
        if leaves_this_machine(connection):
            connection = _encrypted(connection, place, secret)
        _prove(connection, place, secret, number)
        connection.settimeout(None)
    except BaseException:
        connection.close()
        raise
    return connection


def _encrypted(connection: socket.socket, place: tuple[str, int], secret: bytes) -> EncryptedSocket:
    try:
        return encrypted(connection, secret, calls=True)
    except ssl.SSLCertVerificationError as error:
        raise _foreign(place) from error
    except ssl.SSLEOFError as error:
        raise EOFError(f"the process that listens at {place} has ended the connection") from error
    except ssl.SSLError as error:
        raise MessageError(
            f"what listens at {place[0]}:{place[1]} does not encrypt as cavmarl does: {error}"
        ) from error


def _prove(connection: socket.socket, place: tuple[str, int], secret: bytes, number: int) -> None:
    hello = _HELLO.pack(MAGIC, VERSION, number, secrets.token_bytes(NONCE))
    connection.sendall(hello)
    received = b""
    while len(received) < NONCE + PROOF:
        more = b""
        with suppress(ConnectionError, ssl.SSLError):
            more = connection.recv(NONCE + PROOF - len(received))
        if not more and len(received) == _SPOKEN.size and received[:4] == MAGIC:
            raise MessageError(
                f"what listens at {place[0]}:{place[1]} speaks version {_SPOKEN.unpack(received)[1]}, "
                f"this is {VERSION}: install the same cavmarl on all machines"
            )
        if not more:
            raise EOFError(f"the process that listens at {place} has ended the connection")
        received += more
    nonce, proof = received[:NONCE], received[NONCE:]
    if not hmac.compare_digest(proof, _proof(secret, b"caller", hello + nonce)):
        raise _foreign(place)
    connection.sendall(_proof(secret, b"host", hello + nonce))


def _foreign(place: tuple[str, int]) -> MessageError:
    return MessageError(
        f"what listens at {place[0]}:{place[1]} does not know the secret: give both the same key"
    )


def _proof(secret: bytes, side: bytes, content: bytes) -> bytes:
    return hmac.digest(secret, side + content, "sha256")
