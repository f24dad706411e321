"""`FollowerConnection`: one end of the connection between a world and a follower.

`Reception` accepts followers while a world runs, without waiting for any of them.
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
from typing import Any, NamedTuple

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
from cavmarl.cosim.followers.framed_socket import HEAD_BYTES, FramedSocket, bytes_before_data

Array = NDArray[Any]

# A path of a Unix socket, or a port of this machine.
Address = str | Path | int

LOOPBACK = "127.0.0.1"
MAX_PATH = 100  # bytes that every system takes for a Unix socket
# Dtypes of arrays, as NumPy writes them: numbers, and nothing that points anywhere.
_DTYPES = {np.dtype(code).newbyteorder("<").str for code in "?bBhHiIqQefd"}
_MAX_AXES = 8


class ReceivedFrame(NamedTuple):
    """One frame."""

    kind: Say  # what it says
    payload: Any  # as msgpack knows it
    size: int  # bytes of its data


class _Patient(socket.socket):
    """A socket that has until a deadline for all calls together, and can read ahead."""

    until_s: float | None = None  # by `time.monotonic`; None: for ever
    ahead = b""  # has been read, and is taken next

    def read_ahead(self, size: int) -> bool:
        """Whether so many bytes have come by now, which are kept; this does not wait.

        Raises:
            EOFError: the other end has ended.
        """
        self.settimeout(0.0)
        with suppress(BlockingIOError):
            while len(self.ahead) < size:
                more = self.recv(size - len(self.ahead))
                if not more:
                    raise EOFError("the connection has ended")
                self.ahead += more
        return len(self.ahead) >= size

    def _hurry(self) -> None:
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
        self._hurry()
        return super().recv_into(buffer, *arguments, **named)

    def sendmsg(self, *arguments: Any, **named: Any) -> int:
        self._hurry()
        return super().sendmsg(*arguments, **named)


class FollowerConnection:
    """Sends and hears frames; whatever goes wrong with the other end is a `FollowerError`.

    `connection`: a connected socket, which the line owns from here on. `name`: of the other end,
    for people. `cure`: what can be done when that is gone, as the end of a sentence.
    """

    def __init__(self, connection: socket.socket, name: str, cure: str = "") -> None:
        self._socket = _Patient(fileno=connection.detach())
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
            kind: what it says.
            message: one of `messages`; None: nothing.
            arrays: contiguous.
            within_s: for so long it may take.

        Raises:
            FollowerLostError: the other end does not read; the other end is gone.
        """
        self._allow(within_s)
        payload = None if message is None else payload_of(message)
        with self._blaming("read", within_s):
            self._wire.send(kind, 0, payload, arrays)

    def hear(self, within_s: float | None = None) -> ReceivedFrame:
        """The next frame; its data then have to be taken (`take`) or left out (`skip`).

        Raises FollowerLostError: there is none in time; the other end is gone; FollowerError: this
        is no frame, or one of another version.
        """
        self._allow(within_s)
        with self._blaming("answered", within_s):
            frame = self._wire.receive()
        return ReceivedFrame(Say(frame.kind), frame.payload, frame.size)

    def has_come(self) -> bool:
        """Whether the next frame is here but for its data, so that `hear` does not wait.

        Raises FollowerError: as of `hear`.
        """
        with self._blaming("introduced itself", None):
            if not self._socket.read_ahead(HEAD_BYTES):
                return False
            head = self._socket.ahead[:HEAD_BYTES]
            return self._socket.read_ahead(bytes_before_data(head, FOLLOWERS))

    def skip(self, heard: ReceivedFrame) -> None:
        """Leave out the data of what was heard.

        Raises FollowerError: as of `hear`; and there are some, where none belong.
        """
        if heard.size:
            raise FollowerError(
                f"{self.name}: {heard.size} bytes of data with a {heard.kind.name}: it has none"
            )
        self._take([])

    def take(self, heard: ReceivedFrame) -> tuple[FollowerSnapshot, list[Array]]:
        """The snapshot that was heard, with its arrays.

        Raises FollowerError: as of `hear`.
        """
        snapshot = read_payload(FollowerSnapshot, heard.payload)
        sizes = [_size(view) for view in snapshot.arrays]
        if sum(sizes) != heard.size:
            raise FollowerError(
                f"{self.name}: {heard.size} bytes of data, but its arrays have {sum(sizes)}"
            )
        arrays = [np.empty(view.shape, dtype=view.dtype) for view in snapshot.arrays]
        self._take(arrays)
        return snapshot, arrays

    def close(self) -> None:
        self._wire.close()

    def _take(self, arrays: list[Array]) -> None:
        with self._blaming("sent its data", None):
            self._wire.take(arrays)

    @contextmanager
    def _blaming(self, what: str, within_s: float | None) -> Iterator[None]:
        """Say of the other end what goes wrong while it should do `what`."""
        try:
            yield
        except TimeoutError as error:
            raise self.too_late(what, within_s) from error
        except (EOFError, OSError) as error:
            raise FollowerLostError(f"{self.name} has ended ({error}){self._cure}") from error
        except MessageError as error:
            raise FollowerError(f"{self.name}: {error}") from error

    def _allow(self, within_s: float | None) -> None:
        self._socket.until_s = None if within_s is None else time.monotonic() + within_s

    def too_late(self, what: str, within_s: float | None) -> FollowerLostError:
        """The error that says that the other end has not done `what` in time."""
        span = "in time" if within_s is None else f"within {within_s:.3g} s"
        return FollowerLostError(
            f"{self.name} has not {what} {span}: it is dead, stopped or too slow{self._cure}",
            is_late=True,
        )


def _size(view: ArrayView) -> int:
    """Bytes of an array.

    Raises FollowerError: of a dtype that holds no plain numbers, a shape that no array has, or
    stamps of other samples.
    """
    shape, name = view.shape, view.name[:80]
    if view.dtype not in _DTYPES:
        known = ", ".join(sorted(_DTYPES))
        raise FollowerError(f"{name}: dtype '{view.dtype[:80]}' is none of {known}")
    is_shape = 1 <= len(shape) <= _MAX_AXES and all(length >= 0 for length in shape)
    if not is_shape or prod(length or 1 for length in shape) > FOLLOWERS.max_data:
        raise FollowerError(f"{name}: no array has the shape {str(shape)[:80]}")
    if not len(view.stamps_s) == len(view.lost) == shape[0]:
        raise FollowerError(
            f"{name}: {shape[0]} samples with {len(view.stamps_s)} stamps, {len(view.lost)} marks"
        )
    return prod(shape) * np.dtype(view.dtype).itemsize


def listen(address: Address) -> socket.socket:
    """Listen for followers, on this machine only.

    A Unix socket lets in the users that the file system lets in, at first its owner. A port of the
    loopback lets in every user on this machine.

    Args:
        address: a path for a Unix socket, which must not be there; or a port, 0: any that is free.

    Raises:
        ConfigError: the socket cannot be opened.
    """
    if isinstance(address, int):
        try:
            return socket.create_server((LOOPBACK, address))
        except (OSError, OverflowError) as error:
            raise ConfigError(f"port {address}: cannot listen there ({error})") from error
    path = _path_of(address)
    _remove_leftover(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    before = os.umask(0o177)
    try:
        listener.bind(str(path))
        listener.listen()
    except OSError as error:
        listener.close()
        raise ConfigError(f"{path}: cannot listen there ({error})") from error
    finally:
        os.umask(before)
    return listener


def call(address: Address, within_s: float) -> FollowerConnection:
    """Connect to a world that listens at an address.

    Raises FollowerLostError: no process listens there; ConfigError: a path that no socket can have.
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
        raise FollowerLostError(f"{where} does not answer ({error}): is it running?") from error
    return FollowerConnection(connection, where)


def _path_of(address: str | Path) -> Path:
    path = Path(address)
    if len(os.fsencode(path)) > MAX_PATH:
        raise ConfigError(f"{path}: a socket's path has at most {MAX_PATH} bytes; shorten it")
    return path


def _remove_leftover(path: Path) -> None:
    """Remove the socket of a world that has died, and nothing else."""
    if not path.exists() or not stat.S_ISSOCK(path.stat().st_mode):
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()


GREETING_S = 5.0  # for a caller to introduce itself
REFUSING_S = 0.01  # for the words of a refusal, which the system takes at once
NO_DESCRIPTORS_S = 0.05  # until the next attempt to accept
MAX_CALLERS = 64  # not introduced yet
GOES_ON = (
    "the world is whole and can be stepped on, with the built-in driver in its place or another "
    "follower"
)


class Reception:
    """Listens at an address.

    Args:
        address: path of a Unix socket, or a port of this machine.
        secret: that callers have to say; empty: none.

    Attributes:
        address: where it listens; the port that was found, where any would do.
        turned_away: how many callers were not understood, or said nothing.

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
        self.turned_away = 0
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._since: dict[FollowerConnection, float] = {}

    def callers(self, within_s: float = 0.0) -> Iterator[tuple[FollowerConnection, Hello]]:
        """Followers that have introduced themselves since the last call, in order.

        Args:
            within_s: how long to wait for the first; 0: not at all.
        """
        heard = self._selector.select(within_s)
        for key, _ in sorted(heard, key=lambda found: found[0].fd):
            if key.fileobj is self._listener:
                self._open()
                continue
            line = key.data
            if line not in self._since:  # made room for another one
                continue
            try:
                if not line.has_come():
                    continue
                hello = self._greeting(line)
            except FollowerError as error:
                self._forget(line)
                self.turn_away(line, str(error))
                continue
            self._forget(line)
            yield line, hello
        self._dismiss_the_silent()

    def turn_away(self, line: FollowerConnection, reason: str) -> None:
        self.turned_away += 1
        refuse(line, reason)

    def close(self) -> None:
        """Listen no more; a Unix socket's path is removed."""
        for line in list(self._since):
            self._forget(line)
            line.close()
        self._selector.close()
        self._listener.close()

    def _open(self) -> None:
        """Accept all that call now; one too many takes the place of the one that waits longest."""
        for _ in range(MAX_CALLERS):
            try:
                connection, _ = self._listener.accept()
            except OSError as error:  # none calls any more, or it is gone already
                if error.errno in (errno.EMFILE, errno.ENFILE):
                    self._find_descriptor()
                return
            line = FollowerConnection(connection, "a caller", GOES_ON)
            if len(self._since) == MAX_CALLERS:
                self._dismiss_the_oldest("too many callers have not introduced themselves")
            self._since[line] = time.monotonic()
            self._selector.register(line, selectors.EVENT_READ, line)

    def _find_descriptor(self) -> None:
        """This process has none left: the next caller gets one of another caller, or waits."""
        if self._since:
            self._dismiss_the_oldest("this process has no descriptors left")
        else:
            time.sleep(NO_DESCRIPTORS_S)

    def _dismiss_the_oldest(self, reason: str) -> None:
        line = next(iter(self._since))
        self._forget(line)
        self.turn_away(line, reason)

    def _greeting(self, line: FollowerConnection) -> Hello:
        heard = line.hear()
        if heard.kind is not Say.HELLO:
            raise FollowerError(f"a caller begins with {heard.kind.name}: HELLO comes first")
        line.skip(heard)
        hello = read_payload(Hello, heard.payload)
        if self._secret and not compare_digest(hello.secret.encode(), self._secret):
            raise FollowerError("a caller does not know the secret of this world")
        if not hello.name.isprintable():
            raise FollowerError("a caller's name has characters that cannot be printed")
        if len(hello.vehicles) > MAX_VEHICLES:
            raise FollowerError(f"a caller wants {len(hello.vehicles)} vehicles")
        line.name = f"follower '{hello.name[:80]}'"
        return hello

    def _dismiss_the_silent(self) -> None:
        for line, since in list(self._since.items()):
            if time.monotonic() - since > GREETING_S:
                self._forget(line)
                self.turn_away(line, f"has not introduced itself within {GREETING_S:g} s")

    def _forget(self, line: FollowerConnection) -> None:
        del self._since[line]
        self._selector.unregister(line)


def refuse(line: FollowerConnection, reason: str) -> None:
    """Tell a follower why it is not gone on with, if it still listens, and hang up."""
    with suppress(FollowerError):
        line.say(Say.REFUSAL, FollowerRefusal(reason), within_s=REFUSING_S)
    line.close()
