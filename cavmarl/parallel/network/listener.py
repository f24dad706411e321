"""`Listener`: accepts connections of processes that know a secret.

Both ends prove that they know the secret without sending it: each answers the random number of the
other end with an HMAC. Until then, the listener reads only these few bytes. Connections that leave
this machine are encrypted before the handshake.

    caller → listener   HELLO: magic, version, number of the caller, random number
    listener → caller   random number, proof
    caller → listener   proof

A caller of another version receives the version of the listener.
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
VERSION = 1  # version of this handshake
NONCE = 16  # bytes of a random number
PROOF = 32  # bytes of an HMAC
SECRET = 32  # bytes
HANDSHAKE_S = 5.0  # time for each part of the handshake
CALL_S = 5.0  # time to connect
MAX_CALLERS = 64  # largest number of callers that are not authenticated yet
BACKLOG = 1024  # callers that the system holds until they are accepted
NO_DESCRIPTORS_S = 0.05  # pause if another thread takes the last descriptor
_VERSION = struct.Struct("<4sH")
HELLO = struct.Struct(f"<4sHI{NONCE}s")


class PendingConnection:
    """A caller that has not yet proved that it knows the secret."""

    def __init__(self, connection: socket.socket, secret: bytes) -> None:
        connection.setblocking(False)
        self.until_s = time.monotonic() + HANDSHAKE_S  # deadline, by `time.monotonic`
        self.number = -1  # number that the caller claims to have; -1: no HELLO received yet
        self._socket = connection
        if leaves_this_machine(connection):
            self._socket = encrypted(connection, secret, calls=False)
        self._secret = secret
        self._received = b""
        self._expected = b""

    def fileno(self) -> int:
        return self._socket.fileno()

    def listen(self) -> socket.socket | None:
        """Read received bytes; return the connection once the caller has proved the secret.

        Raises:
            OSError: the caller has disconnected.
            EOFError: the caller has ended the connection.
            MessageError: the caller has another protocol or version, or does not know the secret.
        """
        if isinstance(self._socket, EncryptedSocket) and self._socket.version() is None:
            try:
                self._socket.do_handshake()
            except (ssl.SSLWantReadError, ssl.SSLWantWriteError):
                return None
            self._extend()
        wanted = PROOF if self._expected else HELLO.size
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
            self._extend()
            return None
        if not hmac.compare_digest(data, self._expected):
            raise MessageError("a caller does not know the secret")
        return self._socket

    def close(self) -> None:
        self._socket.close()

    def _extend(self) -> None:
        """Renew the deadline: the listener may have been busy in the meantime."""
        self.until_s = time.monotonic() + HANDSHAKE_S

    def _answer(self, hello: bytes) -> None:
        magic, version, self.number, _ = HELLO.unpack(hello)
        if magic != MAGIC:
            raise MessageError(f"a caller sends {hello[:4]!r}, which is not cavmarl's handshake")
        if version != VERSION:
            self._socket.sendall(_VERSION.pack(MAGIC, VERSION))
            raise MessageError(
                f"caller {self.number} has version {version} of the handshake, this process has "
                f"{VERSION}: install the same cavmarl on all machines"
            )
        ours = secrets.token_bytes(NONCE)
        self._expected = _proof(self._secret, b"host", hello + ours)
        self._socket.sendall(ours + _proof(self._secret, b"caller", hello + ours))


class Listener:
    """Admits callers that know the secret; other callers cost little and are disconnected.

    Raises:
        WorkerError: the process cannot listen on the port.
        MissingExtraError: other machines can call, and cryptography is not installed.
    """

    def __init__(
        self,
        address: str,
        secret: bytes | None = None,  # known to the callers; None: a random secret
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
        self._spare = socket.socket()  # closed when descriptors run out, to reject a caller
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)

    def fileno(self) -> int:
        """Return a descriptor that is readable when `admit` has something to do."""
        return self._selector.fileno()

    def admit(self) -> list[tuple[int, socket.socket]]:
        """Serve all callers, without waiting.

        Returns:
            number and connection of each caller that has now proved that it knows the secret.
        """
        admitted: list[tuple[int, socket.socket]] = []
        for key, _ in self._selector.select(0.0):
            if key.fileobj is self._listener:
                for caller in self._welcome():
                    self._listen(caller, admitted)
            elif key.fileobj in self._callers:  # skip callers that were just disconnected
                self._listen(key.fileobj, admitted)
        now = time.monotonic()
        for caller in [caller for caller in self._callers if caller.until_s < now]:
            self._disconnect(caller)
        return admitted

    def _welcome(self) -> Iterator[PendingConnection]:
        """Accept new callers; if there are too many callers, disconnect silent callers first."""
        for _ in range(MAX_CALLERS):
            try:
                connection, _ = self._listener.accept()
            except OSError as error:
                if error.errno not in (errno.EMFILE, errno.ENFILE):
                    return
                self._free_descriptor()
                continue
            if len(self._callers) == MAX_CALLERS:
                self._disconnect_the_first()
            try:
                caller = PendingConnection(connection, self.secret)
            except OSError:  # the caller has disconnected
                connection.close()
                continue
            self._callers.append(caller)
            self._selector.register(caller, selectors.EVENT_READ)
            yield caller

    def _listen(self, caller: PendingConnection, admitted: list[tuple[int, socket.socket]]) -> None:
        try:
            connection = caller.listen()
        except (EOFError, OSError, MessageError):  # not a node of this run
            self._disconnect(caller)
            return
        if connection is not None:
            self._callers.remove(caller)
            self._selector.unregister(caller)
            admitted.append((caller.number, connection))

    def _free_descriptor(self) -> None:
        """Free a descriptor for the next caller, or reject that caller.

        A caller that stayed in the queue would wake this process again at once.
        """
        if self._callers:
            self._disconnect_the_first()
            return
        self._spare.close()
        with suppress(OSError):
            self._listener.accept()[0].close()
        try:
            self._spare = socket.socket()
        except OSError:  # another thread has taken the descriptor
            time.sleep(NO_DESCRIPTORS_S)

    def _disconnect_the_first(self) -> None:
        """Disconnect the oldest caller, preferably a caller that has sent no HELLO."""
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
    answer_s: float | None = None,  # time for the listener to answer; None: unlimited
) -> socket.socket:
    """Call a `Listener`, and return the connection once both ends have proved the secret.

    Raises:
        OSError: nothing listens at the place.
        EOFError: the listener has ended the connection.
        MessageError: the listener does not know the secret, or has another version.
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
        raise EOFError(f"the process at {place} has ended the connection") from error
    except ssl.SSLError as error:
        raise MessageError(
            f"the process at {place[0]}:{place[1]} does not use the encryption of cavmarl: {error}"
        ) from error


def _prove(connection: socket.socket, place: tuple[str, int], secret: bytes, number: int) -> None:
    hello = HELLO.pack(MAGIC, VERSION, number, secrets.token_bytes(NONCE))
    connection.sendall(hello)
    received = b""
    while len(received) < NONCE + PROOF:
        more = b""
        with suppress(ConnectionError, ssl.SSLError):
            more = connection.recv(NONCE + PROOF - len(received))
        if not more and len(received) == _VERSION.size and received[:4] == MAGIC:
            (version,) = _VERSION.unpack(received)[1:]
            raise MessageError(
                f"the process at {place[0]}:{place[1]} has version {version} of the handshake, "
                f"this process has {VERSION}: install the same cavmarl on all machines"
            )
        if not more:
            raise EOFError(f"the process at {place} has ended the connection")
        received += more
    nonce, proof = received[:NONCE], received[NONCE:]
    if not hmac.compare_digest(proof, _proof(secret, b"caller", hello + nonce)):
        raise _foreign(place)
    connection.sendall(_proof(secret, b"host", hello + nonce))


def _foreign(place: tuple[str, int]) -> MessageError:
    return MessageError(
        f"the process at {place[0]}:{place[1]} does not know the secret: give both the same key"
    )


def _proof(secret: bytes, side: bytes, content: bytes) -> bytes:
    return hmac.digest(secret, side + content, "sha256")
