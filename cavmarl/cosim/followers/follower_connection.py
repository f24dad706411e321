"""`FollowerConnection`: one end of the connection between a world and a follower.

`Reception` accepts followers while a world runs, without waiting for them.
"""

from __future__ import annotations

import errno
import os
import selectors
import socket
import stat
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from hmac import compare_digest
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, FollowerError, FollowerLostError, MessageError
from cavmarl.cosim.followers.follower_messages import (
    FOLLOWERS,
    MAX_VEHICLES,
    ArrayView,
    FollowerRefusal,
    FollowerSnapshot,
    Hello,
    Say,
    payload_of,
    read_payload,
)
from cavmarl.cosim.followers.framed_socket import HEAD_BYTES, Frame, FramedSocket, bytes_before_data

Array = NDArray[Any]

# Path of a Unix socket, or a port of this machine.
Address = str | Path | int

LOOPBACK = "127.0.0.1"
MAX_PATH = 100  # maximum number of bytes of a Unix socket's path on every system
# Dtypes of arrays in NumPy's notation: only numbers, no pointers.
_DTYPES = {np.dtype(code).newbyteorder("<").str for code in "?bBhHiIqQefd"}
_MAX_AXES = 8


class _DeadlineSocket(socket.socket):
    """A socket with one deadline for all calls, and with a buffer for reading ahead."""

    until_s: float | None = None  # by `time.monotonic`; None: no deadline
    ahead = b""  # bytes that have been read and are returned next

    def read_ahead(self, size: int) -> bool:
        """Return whether `size` bytes have arrived, without waiting; they are kept for reading.

        Raises:
            EOFError: the other end has closed.
        """
        self.settimeout(0.0)
        with suppress(BlockingIOError):
            while len(self.ahead) < size:
                more = self.recv(size - len(self.ahead))
                if not more:
                    raise EOFError("the connection is closed")
                self.ahead += more
        return len(self.ahead) >= size

    def _set_timeout(self) -> None:
        if self.until_s is None:
            self.settimeout(None)
            return
        left_s = self.until_s - time.monotonic()
        if left_s <= 0.0:
            raise TimeoutError("timed out")
        self.settimeout(left_s)

    def recv_into(self, buffer: Any, *arguments: Any, **named: Any) -> int:
        if self.ahead:
            count = min(len(buffer), len(self.ahead))
            buffer[:count], self.ahead = self.ahead[:count], self.ahead[count:]
            return count
        self._set_timeout()
        return super().recv_into(buffer, *arguments, **named)

    def sendmsg(self, *arguments: Any, **named: Any) -> int:
        self._set_timeout()
        return super().sendmsg(*arguments, **named)


class FollowerConnection:
    """Sends and receives frames; any fault of the other end is raised as a `FollowerError`.

    `connection`: a connected socket, owned by this object from now on. `name`: name of the other
    end, for messages. `cure`: advice for when the other end is lost, as the end of a sentence.
    """

    def __init__(self, connection: socket.socket, name: str, cure: str = "") -> None:
        self._socket = _DeadlineSocket(fileno=connection.detach())
        self._wire = FramedSocket(self._socket, FOLLOWERS)
        self.name = name
        self._cure = f"; {cure}" if cure else ""

    def fileno(self) -> int:
        return self._socket.fileno()

    def say(
        self,
        kind: Say,
        message: Any = None,
        arrays: Sequence[Array] = (),
        within_s: float | None = None,
    ) -> None:
        """Send one frame.

        Args:
            kind: kind of the frame.
            message: one of `follower_messages`; None: no payload.
            arrays: contiguous arrays.
            within_s: time limit.

        Raises:
            FollowerLostError: the other end does not read, or has ended.
        """
        self._set_deadline(within_s)
        payload = None if message is None else payload_of(message)
        with self._peer_errors("read", within_s):
            self._wire.send(kind, 0, payload, arrays)

    def hear(self, within_s: float | None = None) -> Frame:
        """Receive the next frame; then read its data with `take` or `skip`.

        Raises FollowerLostError: no frame arrives in time, or the other end has ended;
        FollowerError: the frame is invalid or of another version.
        """
        self._set_deadline(within_s)
        with self._peer_errors("answered", within_s):
            return self._wire.receive()

    def has_come(self) -> bool:
        """Return whether the next frame has arrived except for its data; then `hear` does not wait.

        Raises FollowerError: as in `hear`.
        """
        with self._peer_errors("introduced itself", None):
            if not self._socket.read_ahead(HEAD_BYTES):
                return False
            head = self._socket.ahead[:HEAD_BYTES]
            return self._socket.read_ahead(bytes_before_data(head, FOLLOWERS))

    def can_send(self) -> bool:
        """Return whether the other end has read enough, so that a frame can be sent at once."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._socket, selectors.EVENT_WRITE)
            return bool(selector.select(0.0))

    def skip(self, frame: Frame) -> None:
        """Check that a frame has no data, and finish reading it.

        Raises FollowerError: as in `hear`; or the frame has data.
        """
        if frame.size:
            raise FollowerError(
                f"{self.name}: {frame.size} bytes of data with a {frame.kind.name}, which has none"
            )
        self._take([])

    def take(self, frame: Frame) -> tuple[FollowerSnapshot, list[Array]]:
        """Return the snapshot of a frame, with its arrays.

        Raises FollowerError: as in `hear`.
        """
        snapshot = read_payload(FollowerSnapshot, frame.payload)
        sizes = [_size(view) for view in snapshot.arrays]
        if sum(sizes) != frame.size:
            raise FollowerError(
                f"{self.name}: {frame.size} bytes of data, but its arrays have {sum(sizes)}"
            )
        arrays = [np.empty(view.shape, dtype=view.dtype) for view in snapshot.arrays]
        self._take(arrays)
        return snapshot, arrays

    def close(self) -> None:
        self._wire.close()

    def _take(self, arrays: list[Array]) -> None:
        with self._peer_errors("sent its data", None):
            self._wire.take(arrays)

    @contextmanager
    def _peer_errors(self, what: str, within_s: float | None) -> Iterator[None]:
        """Raise errors of the connection as errors of the other end.

        `what`: the expected action as a participle, such as "answered", for the message.
        """
        try:
            yield
        except TimeoutError as error:
            raise self.too_late(what, within_s) from error
        except (EOFError, OSError) as error:
            raise FollowerLostError(f"{self.name} has ended ({error}){self._cure}") from error
        except MessageError as error:
            raise FollowerError(f"{self.name}: {error}") from error

    def _set_deadline(self, within_s: float | None) -> None:
        self._socket.until_s = None if within_s is None else time.monotonic() + within_s

    def too_late(self, what: str, within_s: float | None) -> FollowerLostError:
        """Return the error of a peer that is late; `what` is a participle, such as "answered"."""
        span = "in time" if within_s is None else f"within {within_s:.3g} s"
        return FollowerLostError(
            f"{self.name} has not {what} {span}; it is dead, stopped or too slow{self._cure}",
            is_late=True,
        )


def _size(view: ArrayView) -> int:
    """Return the number of bytes of an array.

    Raises FollowerError: the dtype is not a plain number, the shape is invalid, or the number of
    stamps differs from the number of samples.
    """
    shape, name = view.shape, view.name[:80]
    if view.dtype not in _DTYPES:
        known = ", ".join(sorted(_DTYPES))
        raise FollowerError(f"{name}: dtype '{view.dtype[:80]}': must be one of {known}")
    is_shape = 1 <= len(shape) <= _MAX_AXES and all(length >= 0 for length in shape)
    if not is_shape or prod(length or 1 for length in shape) > FOLLOWERS.max_data:
        raise FollowerError(f"{name}: invalid shape {str(shape)[:80]}")
    if not len(view.stamps_s) == len(view.lost) == shape[0]:
        raise FollowerError(
            f"{name}: {shape[0]} samples with {len(view.stamps_s)} stamps and {len(view.lost)} "
            "flags `lost`; give one of each per sample"
        )
    return prod(shape) * np.dtype(view.dtype).itemsize


def listen(address: Address) -> socket.socket:
    """Listen for followers, on this machine only.

    A Unix socket admits the users that its file permissions allow, initially its owner. A port of
    the loopback interface admits every user of this machine.

    Args:
        address: a path for a Unix socket, which must not exist; or a port, 0: any free port.

    Raises:
        ConfigError: the socket cannot be opened.
    """
    if isinstance(address, int):
        try:
            return socket.create_server((LOOPBACK, address))
        except (OSError, OverflowError) as error:
            raise ConfigError(f"port {address}: cannot be opened ({error}); use another") from error
    path = _path_of(address)
    _remove_dead_socket(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    before = os.umask(0o177)
    try:
        listener.bind(str(path))
        listener.listen()
    except OSError as error:
        listener.close()
        raise ConfigError(f"{path}: cannot be opened ({error}); use another path") from error
    finally:
        os.umask(before)
    return listener


def call(address: Address, within_s: float) -> FollowerConnection:
    """Connect to a world that listens at an address.

    Raises FollowerLostError: no process listens there; ConfigError: the path is too long.
    """
    family = socket.AF_INET if isinstance(address, int) else socket.AF_UNIX
    place = (LOOPBACK, address) if isinstance(address, int) else str(_path_of(address))
    where = f"the world at {address}"
    connection = socket.socket(family, socket.SOCK_STREAM)
    try:
        connection.settimeout(within_s)
        connection.connect(place)
    except (OSError, OverflowError) as error:
        connection.close()
        raise FollowerLostError(f"{where} does not answer ({error}); start it first") from error
    return FollowerConnection(connection, where)


def _path_of(address: str | Path) -> Path:
    path = Path(address)
    if len(os.fsencode(path)) > MAX_PATH:
        raise ConfigError(f"{path}: a socket's path has at most {MAX_PATH} bytes; shorten it")
    return path


def _remove_dead_socket(path: Path) -> None:
    """Remove the socket of a world that has died, but no other file."""
    if not path.exists() or not stat.S_ISSOCK(path.stat().st_mode):
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()


GREETING_S = 5.0  # time for a caller to introduce itself
REFUSING_S = 0.01  # time for sending a refusal, which the system buffers at once
NO_DESCRIPTORS_S = 0.05  # wait before the next attempt to accept
MAX_CALLERS = 64  # maximum number of callers that have not introduced themselves
GOES_ON = (
    "the world is intact and can continue, with the built-in driver in its place or another "
    "follower"
)


class Reception:
    """Accepts followers at an address.

    Args:
        address: path of a Unix socket, or a port of this machine.
        secret: required from callers; empty: none.

    Attributes:
        address: where it listens; the chosen port if the given one was 0.

    Raises:
        ConfigError: the socket cannot be opened.
    """

    def __init__(self, address: Address, secret: str = "") -> None:
        if isinstance(address, int) and not secret:
            raise ConfigError(
                f"address = {address}: every user of this machine can call a port; give a secret "
                "(cavmarl lead --secret-file), or the path of a Unix socket"
            )
        self._secret = secret.encode()
        self._listener = listen(address)
        self._listener.setblocking(False)
        name = self._listener.getsockname()
        self.address: Address = name[1] if isinstance(name, tuple) else name
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._since: dict[FollowerConnection, float] = {}

    def callers(self, within_s: float = 0.0) -> Iterator[tuple[FollowerConnection, Hello]]:
        """Yield followers that have introduced themselves since the last call, in order.

        Args:
            within_s: how long to wait for the first follower; 0: not at all.
        """
        ready = self._selector.select(within_s)
        for key, _ in sorted(ready, key=lambda found: found[0].fd):
            if key.fileobj is self._listener:
                self._open()
                continue
            line = key.data
            if line not in self._since:  # already dropped to make room for another caller
                continue
            try:
                if not line.has_come():
                    continue
                hello = self._greeting(line)
            except FollowerError as error:
                self._forget(line)
                refuse(line, str(error))
                continue
            self._forget(line)
            yield line, hello
        self._drop_silent_callers()

    def close(self) -> None:
        """Stop listening."""
        for line in list(self._since):
            self._forget(line)
            line.close()
        self._selector.close()
        self._listener.close()

    def _open(self) -> None:
        """Accept all waiting callers; if there are too many, drop the longest-waiting caller."""
        for _ in range(MAX_CALLERS):
            try:
                connection, _ = self._listener.accept()
            except OSError as error:  # no more callers, or the caller has already gone
                if error.errno in (errno.EMFILE, errno.ENFILE):
                    self._free_descriptor()
                return
            line = FollowerConnection(connection, "a caller", GOES_ON)
            if len(self._since) == MAX_CALLERS:
                self._drop_oldest_caller("too many callers have not introduced themselves")
            self._since[line] = time.monotonic()
            self._selector.register(line, selectors.EVENT_READ, line)

    def _free_descriptor(self) -> None:
        """Free a file descriptor by dropping a caller; without callers, wait."""
        if self._since:
            self._drop_oldest_caller("this process has no descriptors left")
        else:
            time.sleep(NO_DESCRIPTORS_S)

    def _drop_oldest_caller(self, reason: str) -> None:
        line = next(iter(self._since))
        self._forget(line)
        refuse(line, reason)

    def _greeting(self, line: FollowerConnection) -> Hello:
        frame = line.hear()
        if frame.kind is not Say.HELLO:
            raise FollowerError(f"a caller sent {frame.kind.name} first; it must be HELLO")
        line.skip(frame)
        hello = read_payload(Hello, frame.payload)
        if self._secret and not compare_digest(hello.secret.encode(), self._secret):
            raise FollowerError("a caller does not know the secret of this world")
        if not hello.name.isprintable():
            raise FollowerError("a caller's name has characters that cannot be printed")
        if len(hello.vehicles) > MAX_VEHICLES:
            raise FollowerError(
                f"a caller requests {len(hello.vehicles)} vehicles; the limit is {MAX_VEHICLES}"
            )
        if len(hello.actors) > MAX_VEHICLES:
            raise FollowerError(
                f"a caller brings {len(hello.actors)} actors; the limit is {MAX_VEHICLES}"
            )
        line.name = f"follower '{hello.name[:80]}'"
        return hello

    def _drop_silent_callers(self) -> None:
        for line, since in list(self._since.items()):
            if time.monotonic() - since > GREETING_S:
                self._forget(line)
                refuse(line, f"a caller has not introduced itself within {GREETING_S:g} s")

    def _forget(self, line: FollowerConnection) -> None:
        del self._since[line]
        self._selector.unregister(line)


def refuse(line: FollowerConnection, reason: str) -> None:
    """Send a follower the reason why it is dropped, if it still listens, and close."""
    with suppress(FollowerError):
        line.say(Say.REFUSAL, FollowerRefusal(reason), within_s=REFUSING_S)
    line.close()
