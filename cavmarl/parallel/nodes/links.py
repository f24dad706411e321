"""`Links`: the connections of a process to others, over which whole frames go.

A frame is a head of fixed size and bytes. Frames of a connection arrive in their order, or the
connection has ended. Nothing in a frame is ever run.

    head    magic, version, kind, number, bytes of what follows, checksum of what follows,
            checksum of the head

The head's checksum begins with how many frames went before on that connection, so that one that
comes twice or out of turn is no frame. It is compared before anything else of the frame is awaited.
"""

from __future__ import annotations

import json
import select
import socket
import struct
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from enum import IntEnum
from typing import Any, NamedTuple, TypeAlias

from cavmarl.core.errors import MessageError, NodeRefusedError
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.parallel.nodes.node_system import MACHINE, NodeSystem

MAGIC = b"cavN"
VERSION = 4
MAX_FRAME = 1 << 32
_ALL = (1 << 32) - 1
_HEAD = struct.Struct("<4sHHQQI")
_SUM = struct.Struct("<I")
HEAD_BYTES = _HEAD.size + _SUM.size
MOST = 512  # pieces that the system is given at once

# A machine that vanishes says nothing: after so many seconds it is asked, and again, so often.
_ALIVE = [(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)] + [
    (socket.IPPROTO_TCP, getattr(socket, name), value)
    for name, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 3))
    if hasattr(socket, name)
]

Bytes: TypeAlias = bytes | bytearray | memoryview


class FrameKind(IntEnum):
    """What a frame carries."""

    JOB = 0  # C → N: what to be
    READY = 1  # N → C: where other nodes can call
    JOIN = 2  # N → C: what it runs
    COMMAND = 3  # C → N: a task, and what it needs
    LEASE = 4  # C → N: STEP messages
    REPORT = 5  # N → C: DONE messages, and what the next decision needs
    MESSAGES = 6  # N → N, N → C: the protocol's other messages
    RESULT = 7  # N → C: what a task gave
    FAILED = 8  # N → C: an error
    SHARE = 9  # N → N: a part of a tick
    KEEP = 10  # N → N: the state of a node's zones, for when it is lost
    RECOVER = 11  # C → N: nodes are lost or new; begin, or go back to a state that was kept
    SYNC = 12  # N → N: all before this is of no use any more
    PING = 13  # C → N: answer at once
    PONG = 14  # N → C: the answer
    AGENT = 15  # N → N: what is kept of an agent whose vehicle changes its node
    WANTED = 16  # N → C: files that it does not have
    FILES = 17  # C → N: those
    MISSED = 18  # N → C: the connection to another node has ended
    REFUSED = 19  # C → N: why it is of no use
    END = 20  # C → N: it is needed no more
    GIVE = 21  # N → N: the state of zones that another node hosts from now on
    NOT_MINE = 22  # N → C: agents whose actions have come to the wrong node, and their owners
    ACTIONS = 23  # C → N: those
    EXCHANGE = 24  # N → C: messages that are sent, for a network simulator
    RECEPTIONS = 25  # C → N: which of them are received where
    PHASE = 26  # C → N, N → C: messages of the protocol that a plan of faults may harm


class NodeFrame(NamedTuple):
    """A frame that has come."""

    kind: FrameKind
    number: int  # which of its kind, as both ends count
    data: memoryview


_KINDS = frozenset(FrameKind)
URGENT = frozenset(
    {
        FrameKind.MESSAGES,
        FrameKind.KEEP,
        FrameKind.PING,
        FrameKind.PONG,
        FrameKind.MISSED,
        FrameKind.AGENT,
        FrameKind.FAILED,
        FrameKind.GIVE,
        FrameKind.NOT_MINE,
        FrameKind.ACTIONS,
        FrameKind.EXCHANGE,
        FrameKind.RECEPTIONS,
    }
)
Urgent: TypeAlias = Callable[[int, NodeFrame], None]
"""What is called with an urgent frame as soon as it has come, and the number of its sender."""


class SilenceError(Exception):
    """Nothing has come for long."""


class LinkLostError(Exception):
    """A connection has ended, or what came over it was no frame."""

    def __init__(self, peer: int, cause: Exception | None = None) -> None:
        why = f": {cause}" if isinstance(cause, MessageError) else ""
        super().__init__(f"the connection to node {peer} has ended{why}")
        self.peer = peer


class NeededNoMoreError(Exception):
    """The coordinator says that this node may end."""


class RecoveryOrderedError(Exception):
    """A node is to go back to a state that was kept; the order itself, if it has come."""

    def __init__(self, frame: NodeFrame | None) -> None:
        super().__init__("other nodes are lost")
        self.frame = frame


class Link:
    """One connection: what is to be sent, and what has come of the next frame."""

    def __init__(self, connection: socket.socket) -> None:
        if connection.family != socket.AF_UNIX:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for level, option, value in _ALIVE:
                connection.setsockopt(level, option, value)
        connection.setblocking(False)
        self.socket = connection
        self.waiting: deque[Bytes] = deque()
        self.frames: deque[NodeFrame] = deque()
        self._head = bytearray(HEAD_BYTES)
        self._into = memoryview(self._head)
        self._opened: tuple[FrameKind, int, int, bytearray] | None = None
        self._num_sent = self._num_heard = 0  # frames
        # of what has been decrypted and not read yet a poll tells nothing
        self._has_more = hasattr(connection, "pending")

    def send(self, kind: FrameKind, number: int, pieces: Sequence[Bytes]) -> int:
        """Send what the system takes at once; the rest is kept, as a copy.

        Returns:
            bytes of the frame.
        """
        views: list[Bytes] = [b""]
        checksum = size = 0
        for piece in pieces:
            if len(piece):
                view = piece if type(piece) is bytes else memoryview(piece).cast("B")
                checksum = zlib.crc32(view, checksum)
                size += len(view)
                views.append(view)
        self._num_sent = self._num_sent + 1 & _ALL
        head = _HEAD.pack(MAGIC, VERSION, kind, number, size, checksum)
        views[0] = head + _SUM.pack(zlib.crc32(head, self._num_sent))
        size += HEAD_BYTES
        rest = views if self.waiting else self._unsent(views, size)
        self.waiting.extend(memoryview(bytes(view)) for view in rest)
        return size

    def go_on_sending(self) -> None:
        self.waiting = deque(self._unsent(list(self.waiting), sum(map(len, self.waiting))))

    def _unsent(self, pieces: list[Bytes], size: int) -> list[Bytes]:
        """What is left of pieces of so many bytes after the system has taken all it can."""
        while pieces:
            try:
                sent = self.socket.sendmsg(pieces if len(pieces) <= MOST else pieces[:MOST])
            except BlockingIOError:
                break
            if sent == size:
                return []
            size -= sent
            while sent >= len(pieces[0]):
                sent -= len(pieces.pop(0))
            if sent:
                pieces[0] = pieces[0][sent:]
        return pieces

    def receive(self, urgent: Urgent, number: int) -> None:
        """Take what has come, or one frame where a poll tells of the next.

        Raises:
            EOFError, OSError: the other end has gone.
            MessageError: what came is no frame.
            NeededNoMoreError, NodeRefusedError: the coordinator has said its last word.
        """
        while True:
            if left := len(self._into):
                try:
                    got = self.socket.recv_into(self._into)
                except BlockingIOError:
                    return
                if not got:
                    raise EOFError
                if got < left:
                    self._into = self._into[got:]
                    continue
            if self._opened is None:
                self._open()
            else:
                frame = self._close()
                if frame.kind is FrameKind.END:
                    raise NeededNoMoreError
                if frame.kind is FrameKind.REFUSED:
                    raise NodeRefusedError(f"the caller refuses this node: {_text(frame)}")
                if frame.kind in URGENT:
                    urgent(number, frame)
                else:
                    self.frames.append(frame)
                if not self._has_more:
                    return

    def _open(self) -> None:
        magic, version, kind, number, size, checksum = _HEAD.unpack_from(self._head)
        if magic != MAGIC:
            raise MessageError(f"{bytes(magic)!r} begins no frame of a node")
        if version != VERSION:
            raise MessageError(
                f"a frame of version {version}, this is {VERSION}: install the same cavmarl "
                "everywhere"
            )
        self._num_heard = self._num_heard + 1 & _ALL
        found = zlib.crc32(memoryview(self._head)[: _HEAD.size], self._num_heard)
        if _SUM.unpack_from(self._head, _HEAD.size) != (found,):
            raise MessageError("a frame's head is not what was sent, or not the next one")
        if size > MAX_FRAME or kind not in _KINDS:
            raise MessageError(f"a frame of kind {kind} with {size} bytes is none")
        room = bytearray(size)
        self._opened = (FrameKind(kind), number, checksum, room)
        self._into = memoryview(room)

    def _close(self) -> NodeFrame:
        assert self._opened is not None
        kind, number, checksum, room = self._opened
        if zlib.crc32(room) != checksum:
            raise MessageError("a frame is not what was sent")
        self._opened, self._into = None, memoryview(self._head)
        return NodeFrame(kind, number, memoryview(room))


class Links:
    """Connections by the number of the process at the other end."""

    def __init__(self, urgent: Urgent, system: NodeSystem = MACHINE) -> None:
        self.urgent = urgent
        self.now_s = system.now_s
        self._links: dict[int, Link] = {}
        self._poll = system.poll()
        self._by_socket: dict[int, int] = {}
        self.awaited: set[int] = set()  # whose frames `take` waits for
        self.waited_s = 0.0
        self.sent_bytes = 0
        self.sent_frames = 0

    def add(self, number: int, connection: socket.socket | Link) -> None:
        link = connection if isinstance(connection, Link) else Link(connection)
        self._links[number] = link
        self._by_socket[link.socket.fileno()] = number
        self._poll.register(link.socket, select.POLLIN)

    @property
    def numbers(self) -> tuple[int, ...]:
        return tuple(self._links)

    def send(self, to: int, kind: FrameKind, number: int, pieces: Sequence[Bytes] = ()) -> None:
        """Send a frame.

        Raises:
            LinkLostError: the other end has gone.
        """
        link = self._links.get(to)
        if link is None:
            raise LinkLostError(to)
        self.sent_frames += 1
        try:
            self.sent_bytes += link.send(kind, number, pieces)
        except OSError as error:
            self.drop(to)
            raise LinkLostError(to) from error
        if link.waiting:
            self._poll.modify(link.socket, select.POLLIN | select.POLLOUT)

    def take(
        self,
        wanted: Iterable[int],  # numbers of the nodes whose frames are awaited
        timeout_s: float | None = None,  # None: as long as it takes
    ) -> dict[int, NodeFrame]:
        """The next frame of each.

        Raises:
            LinkLostError: one of them has gone.
            MessageError: what came is no frame.
            SilenceError: nothing has come in time.
            RecoveryOrderedError: the coordinator has one that is not awaited.
        """
        numbers = list(wanted)
        until_s = None if timeout_s is None else self.now_s() + timeout_s
        while True:
            if COORDINATOR not in numbers:
                self.heed()
            for number in numbers:
                if number not in self._links:
                    raise LinkLostError(number)
            self.awaited = {number for number in numbers if not self._links[number].frames}
            if not self.awaited:
                return {number: self._links[number].frames.popleft() for number in numbers}
            left_ms = None if until_s is None else 1e3 * max(until_s - self.now_s(), 0.0)
            if left_ms == 0.0:
                missing = sorted(self.awaited)
                raise SilenceError(f"nodes {missing} do not answer within {timeout_s:g} s")
            self.pump(left_ms)

    def heed(self) -> None:
        """Raises RecoveryOrderedError: the coordinator's order to go back has come.

        What is awaited then may never come: its sender may be lost without anyone noticing here.
        """
        link = self._links.get(COORDINATOR)
        if link is not None and any(frame.kind is FrameKind.RECOVER for frame in link.frames):
            raise RecoveryOrderedError(None)

    def arrived(self, number: int) -> NodeFrame | None:
        """The next frame of one, if it has come."""
        frames = self._links[number].frames
        return frames.popleft() if frames else None

    def has(self, number: int) -> bool:
        """Whether a frame of one has come that has not been taken."""
        return number in self._links and bool(self._links[number].frames)

    def release(self, number: int) -> Link:
        """Give a connection away."""
        return self._forget(number)

    def put_back(self, number: int, frame: NodeFrame) -> None:
        """Let a frame be the next one of its sender once more."""
        self._links[number].frames.appendleft(frame)

    def pump(self, timeout_ms: float | None) -> None:
        """Send and receive what can be; wait so long for the first that can."""
        began_s = self.now_s()
        ready = self._poll.poll(timeout_ms)
        self.waited_s += self.now_s() - began_s
        for socket_number, _ in ready:
            number = self._by_socket[socket_number]
            link = self._links[number]
            try:
                if link.waiting:
                    link.go_on_sending()
                    if not link.waiting:
                        self._poll.modify(link.socket, select.POLLIN)
                link.receive(self.urgent, number)
            except (EOFError, OSError, MessageError) as error:
                self.drop(number)
                raise LinkLostError(number, error) from error

    def flush(self) -> None:
        """Wait until all that is to be sent is sent."""
        while any(link.waiting for link in self._links.values()):
            self.pump(None)

    def drop(self, number: int) -> None:
        """End a connection, if there is one."""
        if number in self._links:
            self._forget(number).socket.close()

    def _forget(self, number: int) -> Link:
        link = self._links.pop(number)
        self._poll.unregister(link.socket)
        del self._by_socket[link.socket.fileno()]
        return link

    def end(self, timeout_s: float) -> None:
        """Tell all that they are needed no more, and wait a while for them to end."""
        for number in self.numbers:
            with suppress(LinkLostError):
                self.send(number, FrameKind.END, 0)
        self.urgent = _unheard
        until_s = self.now_s() + timeout_s
        while self._links and self.now_s() < until_s:
            with suppress(LinkLostError):
                self.pump(1e3 * max(until_s - self.now_s(), 0.0))
        self.close()

    def close(self) -> None:
        for number in self.numbers:
            self.drop(number)


def said_by(frame: NodeFrame) -> list[Any]:
    """A list as JSON. Raises MessageError: it is none."""
    try:
        said = json.loads(bytes(frame.data))
    except ValueError as error:
        raise MessageError(f"a frame of kind {frame.kind.name} says nothing: {error}") from error
    if not isinstance(said, list):
        raise MessageError(f"a frame of kind {frame.kind.name} says {said!r}")
    return said


def _text(frame: NodeFrame) -> str:
    return bytes(frame.data).decode(errors="replace")


def _unheard(number: int, frame: NodeFrame) -> None:
    """What is of no use any more."""
