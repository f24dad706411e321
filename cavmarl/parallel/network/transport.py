"""`Transport`: carries bytes between the processes of a run.

Code above this interface does not depend on the kind of a connection. There are three
implementations: `TcpTransport`, `MpiTransport`, and the network in memory of the simulated machine
of `cavmarl.verify`.
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
MOST_PIECES = 512  # limit in one call of `Connection.send`


class Connection(Protocol):
    """One end of a stream of bytes between two processes. Calls do not block."""

    @property
    def address(self) -> str:
        """The address of this end, as the other end can reach it."""
        ...

    @property
    def keeps_bytes(self) -> bool:
        """True if received bytes may wait here although a poll does not report them."""
        ...

    @property
    def closed(self) -> bool:
        """True if the other end has closed, and all bytes before that have been received."""
        ...

    def send(self, pieces: Sequence[Bytes]) -> int:
        """Send the pieces in order; return the number of bytes that the system has accepted.

        Raises:
            OSError: the other end has disconnected.
        """
        ...

    def receive(self, room: memoryview) -> int:
        """Read into `room`; return the number of bytes, 0 if none has arrived or the end closed.

        Raises:
            OSError: the other end has disconnected.
        """
        ...

    def fileno(self) -> int:
        """Return the number by which a poll reports this connection."""
        ...

    def close(self) -> None: ...


class TransportListener(Protocol):
    """A place to which other processes open connections."""

    @property
    def place(self) -> Place: ...

    def fileno(self) -> int: ...

    def admit(self) -> list[tuple[int, Connection]]:
        """Return new connections, each with the number that its opener gives."""
        ...

    def close(self) -> None: ...


class TransportPoll(Protocol):
    """Waits for connections and listeners, as `select.poll` does."""

    def register(self, one: Any, events: int) -> None: ...

    def modify(self, one: Any, events: int) -> None: ...

    def unregister(self, one: Any) -> None: ...

    def poll(self, timeout_ms: float | None) -> list[tuple[int, int]]:
        """Wait up to `timeout_ms`; return the numbers and events of sockets that are ready."""
        ...


class Transport(Protocol):
    """Opens connections, and listens for them."""

    def open(
        self,
        place: Place,
        secret: bytes,  # known to both processes
        number: int,  # sent to the listener
        answer_s: float | None,  # time for the listener to answer; None: unlimited
    ) -> Connection:
        """Open a connection to a listener.

        Raises:
            OSError: nothing listens at the place.
            EOFError: the listener has ended the connection.
            MessageError: the listener does not know the secret, or has another version.
        """
        ...

    def listen(self, address: str, secret: bytes) -> TransportListener: ...

    def poll(self) -> TransportPoll: ...
