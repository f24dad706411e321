"""`Transport`: what carries bytes between the processes of a run.

Nothing above this interface knows what a connection is made of. There are three implementations:
`TcpTransport`, `MpiTransport`, and the network of `cavmarl.verify`'s simulated machine, which is in
memory.
"""

from __future__ import annotations

import select
from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias

Bytes: TypeAlias = bytes | bytearray | memoryview

Place: TypeAlias = tuple[str, int]
"""Where a process listens: host and port, or `mpi` and rank."""

READS = select.POLLIN
READS_AND_WRITES = select.POLLIN | select.POLLOUT
MOST_PIECES = 512  # that are given to `Connection.send` at once


class Connection(Protocol):
    """One end of a stream of bytes between two processes. No call waits."""

    @property
    def address(self) -> str:
        """The address of this end, as the other one reaches it."""
        ...

    @property
    def keeps_bytes(self) -> bool:
        """Whether it may keep bytes that have come and that no poll tells of."""
        ...

    @property
    def closed(self) -> bool:
        """Whether the other end has ended, and all that came before that has been received."""
        ...

    def send(self, pieces: Sequence[Bytes]) -> int:
        """Send pieces as one; how many of their first bytes are taken, maybe none.

        Raises:
            OSError: the other end has gone.
        """
        ...

    def receive(self, room: memoryview) -> int:
        """Write what has come into `room`; how many bytes: 0, if none have come or will come.

        Raises:
            OSError: the other end has gone.
        """
        ...

    def fileno(self) -> int:
        """The number by which a poll tells of it."""
        ...

    def close(self) -> None: ...


class TransportListener(Protocol):
    """A place where other processes open connections."""

    @property
    def place(self) -> Place: ...

    def fileno(self) -> int: ...

    def admit(self) -> list[tuple[int, Connection]]:
        """Connections that have been opened, and the number that each opener says."""
        ...

    def close(self) -> None: ...


class TransportPoll(Protocol):
    """Waits for connections and listeners, as `select.poll` does."""

    def register(self, one: Any, events: int) -> None: ...

    def modify(self, one: Any, events: int) -> None: ...

    def unregister(self, one: Any) -> None: ...

    def poll(self, timeout_ms: float | None) -> list[tuple[int, int]]:
        """Numbers of those that can receive or send, within that time."""
        ...


class Transport(Protocol):
    """Opens connections of a kind."""

    def open(
        self,
        place: Place,
        secret: bytes,  # that both ends have to know
        number: int,  # that is said to the listener
        answer_s: float | None,  # for the listener to answer; None: as long as it takes
    ) -> Connection:
        """Open a connection to a listener.

        Raises:
            OSError: nothing listens there.
            EOFError: the listener wants no more.
            MessageError: it does not know the secret, or speaks another version.
        """
        ...

    def listen(self, address: str, secret: bytes) -> TransportListener: ...

    def poll(self) -> TransportPoll: ...
