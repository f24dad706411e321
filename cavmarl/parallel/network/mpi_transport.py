"""`MpiTransport`: connections between the ranks of an MPI run.

A place is `mpi` and a rank. Ranks trust each other, since MPI has started all of them; there is no
secret. MPI has no failover: when it loses a rank, it ends the run.

A message with the tag 0 is a notice about a connection. Every other message carries bytes; its tag
is the number that the receiving rank has given to its end of the connection.
"""

from __future__ import annotations

import atexit
import os
import re
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from enum import IntEnum
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any, Literal

from cavmarl.core.errors import ConfigError, WorkerError, require
from cavmarl.parallel.network.transport import (
    READS,
    Bytes,
    Connection,
    Place,
    TransportListener,
    TransportPoll,
)

MPI: Literal["mpi"] = "mpi"
CALLER = 0  # the rank of the program whose worlds the other ranks host
NOTICE = 0  # tag of notices
LISTENER = 0  # number by which a poll reports the listener
LOOKS = 500  # number of polls before the process sleeps between polls
NAP_S = 50e-6
END_S = 60.0  # time for the other ranks to end after the caller
PRINTED_S = 0.3  # time for printed text to arrive before the run is aborted
HOW = f"mpirun -n 1 python PROGRAM : -n NODES cavmarl node --{MPI}"
MPI_CURE = (
    f"MPI has no failover: start the run again ({HOW}); backend='nodes:N' or 'ray:N' replaces lost "
    "nodes"
)
_NOTICE = struct.Struct("<IIII")
_SHARED = re.compile(r"/dev/shm/mpich_shm_\w+(?= *$)", re.MULTILINE)


class _Notice(IntEnum):
    """Kinds of notices. The comments name the first and the second number of each kind."""

    OPEN = 0  # number of the caller, for the listener; number of the caller's end
    ACCEPT = 1  # number of the listener's end; number of the caller's end
    CLOSE = 2  # unused; number of the receiver's end
    GONE = 3  # two unused numbers; the process of the sender ends


class MpiConnection:
    """A `Connection` to another rank."""

    address, keeps_bytes = MPI, False

    def __init__(self, transport: MpiTransport, rank: int, number: int, far: int) -> None:
        self.rank, self.number, self.far = rank, number, far
        self.come: deque[memoryview] = deque()
        self.has_ended = False  # whether the other end has closed
        self._transport = transport

    @property
    def closed(self) -> bool:
        return self.has_ended and not self.come

    def send(self, pieces: Sequence[Bytes]) -> int:
        if self.has_ended:
            raise BrokenPipeError(f"rank {self.rank} has ended the connection")
        data = b"".join(pieces)
        self._transport.send(self.rank, self.far, data)
        return len(data)

    def receive(self, room: memoryview) -> int:
        if not self.come:
            return 0
        piece = self.come[0]
        got = min(len(room), len(piece))
        room[:got] = piece[:got]
        if got < len(piece):
            self.come[0] = piece[got:]
        else:
            self.come.popleft()
        return got

    def fileno(self) -> int:
        return self.number

    def is_ready(self) -> bool:
        return self.has_ended or bool(self.come)

    def close(self) -> None:
        self._transport.forget(self)


class MpiListener:
    """A `TransportListener` for all ranks."""

    def __init__(self, place: Place) -> None:
        self.place = place
        self.callers: list[tuple[int, Connection]] = []
        self.is_open = True

    def fileno(self) -> int:
        return LISTENER

    def is_ready(self) -> bool:
        return bool(self.callers)

    def admit(self) -> list[tuple[int, Connection]]:
        found, self.callers = self.callers, []
        return found

    def close(self) -> None:
        self.is_open = False
        for _, connection in self.admit():
            connection.close()


class MpiPoll:
    """A `TransportPoll`. A process cannot sleep until MPI has a message, so it polls repeatedly."""

    def __init__(self, receive_all: Callable[[], None]) -> None:
        self._receive_all = receive_all
        self._ones: dict[int, MpiConnection | MpiListener] = {}

    def register(self, one: Any, events: int) -> None:
        self._ones[one.fileno()] = one

    def modify(self, one: Any, events: int) -> None:
        """Do nothing: MPI accepts all bytes at once."""

    def unregister(self, one: Any) -> None:
        del self._ones[one.fileno()]

    def poll(self, timeout_ms: float | None) -> list[tuple[int, int]]:
        until_s = None if timeout_ms is None else time.monotonic() + 1e-3 * timeout_ms
        for look in count():
            self._receive_all()
            ready = [(number, READS) for number, one in self._ones.items() if one.is_ready()]
            if ready or (until_s is not None and time.monotonic() >= until_s):
                return ready
            _rest(look)
        raise AssertionError


class MpiTransport:
    """A `Transport` between the ranks of this run.

    Attributes:
        rank: rank of this process.
        ranks: number of ranks.
        wait_s: time for a rank to answer a call without a limit of its own; None: unlimited.
        is_broken: whether a rank is lost, so that this process aborts the run when it ends.

    Raises:
        MissingExtraError: mpi4py is not installed.
    """

    def __init__(self) -> None:
        require("mpi4py", "mpi")
        from mpi4py import MPI as mpi

        self._mpi, self._comm, self._status = mpi, mpi.COMM_WORLD, mpi.Status()
        self.rank, self.ranks = self._comm.Get_rank(), self._comm.Get_size()
        self.wait_s: float | None = None
        self.is_broken = self._has_left = False
        self._listener = MpiListener((MPI, self.rank))
        self._numbers = count(1)
        self._ends: dict[int, MpiConnection] = {}
        self._gone: set[int] = set()  # ranks that have ended
        self._sent: deque[tuple[Any, bytes]] = deque()  # requests, and the bytes that they send
        _unlink_shared_memory()
        atexit.register(self._end)

    def open(self, place: Place, secret: bytes, number: int, answer_s: float | None) -> Connection:
        end = self._new(place[1], far=0)
        self._send_notice(end.rank, _Notice.OPEN, number, end.number)
        answer_s = self.wait_s if answer_s is None else answer_s
        until_s = None if answer_s is None else time.monotonic() + answer_s
        for look in count():
            self.receive_all()
            if end.far:
                break
            if end.has_ended:
                raise EOFError(f"rank {end.rank} of MPI has ended, or does not listen")
            if until_s is not None and time.monotonic() > until_s:
                end.close()
                raise ConnectionRefusedError(f"rank {end.rank} of MPI does not answer")
            _rest(look)
        return end

    def listen(self, address: str, secret: bytes) -> TransportListener:
        if not self._listener.is_open:
            self._listener = MpiListener((MPI, self.rank))
        return self._listener

    def poll(self) -> TransportPoll:
        return MpiPoll(self.receive_all)

    def _new(self, rank: int, far: int) -> MpiConnection:
        end = MpiConnection(self, rank, next(self._numbers), far)
        end.has_ended = rank in self._gone
        self._ends[end.number] = end
        return end

    def forget(self, end: MpiConnection) -> None:
        """Close a connection, and discard messages that still arrive for it."""
        if self._ends.pop(end.number, None) is not None and end.far and not end.has_ended:
            self._send_notice(end.rank, _Notice.CLOSE, 0, end.far)

    def _send_notice(self, rank: int, what: _Notice, first: int, second: int) -> None:
        if not self._has_left:
            self.send(rank, NOTICE, _NOTICE.pack(what, first, second, 0))

    def send(self, rank: int, tag: int, data: bytes) -> None:
        """Send a message.

        Raises:
            OSError: MPI cannot send it, or this process ends.
        """
        if self._has_left:
            raise BrokenPipeError("this process ends")
        try:
            self._sent.append((self._comm.Isend([data, self._mpi.BYTE], rank, tag), data))
        except self._mpi.Exception as error:
            raise OSError(f"rank {rank} cannot be reached: {error}") from error

    def receive_all(self) -> None:
        """Receive all messages that have arrived.

        Raises:
            WorkerError: MPI has lost a rank.
        """
        mpi, status = self._mpi, self._status
        if mpi.Is_finalized():
            return
        try:
            while (message := self._comm.Improbe(status=status)) is not None:
                data = bytearray(status.Get_count(mpi.BYTE))
                rank, tag = status.Get_source(), status.Get_tag()
                message.Recv([data, mpi.BYTE])
                if tag != NOTICE:
                    if tag in self._ends:
                        self._ends[tag].come.append(memoryview(data))
                else:
                    self._receive_notice(rank, *_NOTICE.unpack(data)[:3])
            while self._sent and self._sent[0][0].Test():
                self._sent.popleft()
        except mpi.Exception as error:
            self.is_broken = True
            raise WorkerError(f"a rank was lost ({error}): {MPI_CURE}") from error

    def _receive_notice(self, rank: int, what: int, first: int, second: int) -> None:
        """Apply a notice about a connection."""
        end = self._ends.get(second)
        if what == _Notice.OPEN:
            end = self._new(rank, far=second)
            self._send_notice(rank, _Notice.ACCEPT, end.number, second)
            if self._listener.is_open:
                self._listener.callers.append((first, end))
            else:
                end.close()
        elif what == _Notice.ACCEPT and end is not None:
            end.far = first
        elif what == _Notice.ACCEPT:  # `open` no longer waits
            self._send_notice(rank, _Notice.CLOSE, 0, first)
        elif what == _Notice.CLOSE and end is not None:
            end.has_ended = True
        elif what == _Notice.GONE:
            self._gone.add(rank)
            for one in self._ends.values():
                one.has_ended |= one.rank == rank

    def check_caller(self, nodes: int) -> None:
        """Refuse a rank that cannot be the caller of this number of nodes.

        Raises:
            ConfigError: this is not the rank of the caller, or there are too few other ranks.
        """
        if self.rank != CALLER:
            raise ConfigError(
                f"backend = 'nodes:{nodes}@{MPI}': this is rank {self.rank}, the caller is rank "
                f"{CALLER}; start the others as nodes: {HOW}"
            )
        if nodes >= self.ranks:
            raise ConfigError(
                f"backend = 'nodes:{nodes}@{MPI}': there are {self.ranks - 1} other ranks; "
                f"start one for each node: {HOW}"
            )

    def _end(self) -> None:
        """Finalize MPI together with all other ranks, or abort the run if a rank is lost.

        MPI ends cleanly only if each message was received, so a rank sends nothing after GONE.
        Objects that Python destroys later, like environments left open, find MPI finalized.
        """
        mpi = self._mpi
        if mpi.Is_finalized():
            return
        others = set(range(self.ranks)) - {self.rank}
        until_s = None
        try:
            for rank in others:
                self._send_notice(rank, _Notice.GONE, 0, 0)
            self._has_left = True
            for look in count():
                self.receive_all()
                if self.is_broken or (others <= self._gone and not self._sent):
                    break
                if until_s is None and CALLER in (self.rank, *self._gone):
                    until_s = time.monotonic() + END_S
                self.is_broken = until_s is not None and time.monotonic() > until_s
                _rest(look)
        except (OSError, WorkerError):
            self.is_broken = True
        if self.is_broken:
            time.sleep(PRINTED_S)
            self._comm.Abort(1)
        mpi.Finalize()


def _unlink_shared_memory() -> None:
    """Remove the names of the memory that the ranks of this machine share.

    All ranks have attached the memory when MPI has started. MPICH removes the names at a clean end,
    and leaves them behind if a rank is killed or the run is aborted.
    """
    maps = Path("/proc/self/maps")
    if maps.exists():  # Linux
        for path in set(_SHARED.findall(maps.read_text())):
            Path(path).unlink(missing_ok=True)


@cache
def mpi_transport() -> MpiTransport:
    """Return the transport of this process."""
    return MpiTransport()


def _rest(look: int) -> None:
    """Yield the core or, after `LOOKS` polls, sleep for a moment."""
    if look < LOOKS:
        os.sched_yield()
    else:
        time.sleep(NAP_S)
