"""`Link`: a connection that carries whole frames.

A frame is a head of fixed size, and data. Frames arrive in the order in which they were sent, or
the connection has ended. Nothing in a frame is ever executed.

    head    magic, version, kind, number, bytes of the data, checksum of the data,
            checksum of the head

Checksums are XXH3 of 64 bits, and guard against accidents only. The checksum of the head has the
number of the frame on its connection as seed, so a repeated or reordered frame is rejected. It is
checked before the data are awaited.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence
from enum import IntEnum
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from xxhash import xxh3_64_intdigest

from cavmarl.core.errors import MessageError, NodeRefusedError
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.parallel.network.transport import MOST_PIECES, Bytes, Connection
from cavmarl.parallel.nodes.peer_faults import read_json

MAGIC = b"cavN"
VERSION = 7
MAX_FRAME = 1 << 32
_ALL = (1 << 64) - 1
BEGIN = MAGIC + VERSION.to_bytes(2, "little")
_HEAD = struct.Struct("<6sHQQQ")
SUMMED = _HEAD.size  # bytes of a head that its checksum covers
_SUM = struct.Struct("<Q")
_WHOLE_HEAD = struct.Struct("<6sHQQQQ")
HEAD_BYTES = _WHOLE_HEAD.size
ROOM = 1 << 14  # bytes of the buffer for heads and small frames


class FrameKind(IntEnum):
    """Kinds of frames; C is the caller, N a node."""

    JOB = 0  # C → N: the worlds to load
    READY = 1  # N → C: where other nodes can call
    JOIN = 2  # N → C: the code that the node runs
    COMMAND = 3  # C → N: a task and its arguments
    LEASE = 4  # C → N: STEP messages
    REPORT = 5  # N → C: DONE messages, and the data that the next decision needs
    MESSAGES = 6  # N → N, N → C: other messages of the protocol
    RESULT = 7  # N → C: the result of a task
    FAILED = 8  # N → C: an error
    SHARE = 9  # N → N: data of a part of a tick, see `NodePeers`
    KEEP = 10  # N → N, N → C: a replica of the state of a node
    RECOVER = 11  # C → N: nodes are lost or new; start, or go back to a kept state
    SYNC = 12  # N → N: all earlier frames are void
    PING = 13  # C → N: answer at once
    PONG = 14  # N → C: the answer
    AGENT = 15  # N → N: state of an agent whose vehicle changes its node
    WANTED = 16  # N → C: files that the node does not have
    FILES = 17  # C → N: these files
    MISSED = 18  # N → C: the connection to another node has ended, or has carried a bad frame
    REFUSED = 19  # C → N: why the node is rejected
    END = 20  # C → N: the node is not needed any more
    GIVE = 21  # N → N: the state of zones that move to another node
    NOT_MINE = 22  # N → C: agents whose actions were sent to the wrong node, and their owners
    ACTIONS = 23  # C → N: forwarded actions
    EXCHANGE = 24  # N → C: sent messages, for a network simulator
    RECEPTIONS = 25  # C → N: received messages, from the network simulator


class NodeFrame(NamedTuple):
    """A received frame."""

    kind: FrameKind
    number: int  # a number whose meaning depends on the kind
    data: memoryview

    def is_of(self, generation: int, is_known: bool) -> bool:
        """Return whether the frame is of this generation of nodes, not of an earlier generation.

        `is_known`: whether its sender has sent a frame of this generation before.

        Raises:
            MessageError: the generation of the frame is later, or is earlier despite `is_known`.
        """
        if self.number == generation:
            return True
        if self.number > generation or is_known:
            raise MessageError(
                f"a frame of kind {self.kind.name} is of generation {self.number}, not {generation}"
            )
        return False


_KINDS = {int(kind): kind for kind in FrameKind}
URGENT = frozenset(  # handled on arrival, before earlier frames of other kinds
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
_AT_ONCE = URGENT | {FrameKind.END, FrameKind.REFUSED}  # do not wait in `Link.frames`


class NeededNoMoreError(Exception):
    """The coordinator does not need this node any more."""


class Link:
    """One connection, with its unsent bytes and the received part of the next frame."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.waiting: deque[memoryview] = deque()
        self.frames: deque[NodeFrame] = deque()
        self._room = memoryview(bytearray(ROOM))  # received bytes, not yet split into frames
        self._filled = 0  # number of bytes in `_room`
        self._into = self._room  # target of the next bytes: `_room`, or an incomplete frame
        self._opened: tuple[NodeFrame, int] | None = None  # incomplete frame, and its checksum
        self._num_sent = self._num_received = 0  # numbers of frames

    def send(self, kind: FrameKind, number: int, pieces: Sequence[Bytes]) -> int:
        """Send as much as the connection accepts at once; keep a copy of the rest.

        Returns:
            size of the frame in bytes.
        """
        data = _joined(pieces)
        self._num_sent = num_sent = self._num_sent + 1 & _ALL
        head = _HEAD.pack(BEGIN, kind, number, len(data), xxh3_64_intdigest(data))
        head += _SUM.pack(xxh3_64_intdigest(head, num_sent))
        size = HEAD_BYTES + len(data)
        sent = 0 if self.waiting else self.connection.send((head, data))
        if sent < size:
            self.waiting.append(memoryview(head)[sent:])
            self.waiting.append(memoryview(bytes(data))[max(sent - HEAD_BYTES, 0) :])
        return size

    def go_on_sending(self) -> None:
        """Send as much of the rest as the connection accepts."""
        waiting = self.waiting
        while waiting:
            sent = self.connection.send(list(islice(waiting, MOST_PIECES)))
            if not sent:
                return
            while waiting and sent >= len(waiting[0]):
                sent -= len(waiting.popleft())
            if sent:
                waiting[0] = waiting[0][sent:]

    def receive(self, urgent: deque[tuple[int, NodeFrame]], number: int) -> None:
        """Read received bytes; append urgent frames to `urgent`, with the number of this link.

        Raises:
            EOFError, OSError: the other end has disconnected.
            MessageError: the bytes are not a frame.
            NeededNoMoreError, NodeRefusedError: the coordinator has dismissed this node.
        """
        while True:
            into = self._into
            got = self.connection.receive(into)
            if not got:
                if self.connection.closed:
                    raise EOFError
                return
            if self._opened is None:
                self._split(self._filled + got, urgent, number)
            elif got < len(into):
                self._into = into[got:]
            else:
                opened, self._opened, self._into = self._opened, None, self._room
                self._close(*opened, urgent, number)
            if got < len(into) and not self.connection.keeps_bytes:
                return

    def _split(self, filled: int, urgent: deque[tuple[int, NodeFrame]], number: int) -> None:
        """Split the bytes in `_room` into frames. The last frame may be incomplete."""
        room, at = self._room, 0
        while filled - at >= HEAD_BYTES:
            begin, code, which, size, summed, own = _WHOLE_HEAD.unpack_from(room, at)
            self._num_received = received = self._num_received + 1 & _ALL
            is_next = xxh3_64_intdigest(room[at : at + SUMMED], received) == own
            if begin != BEGIN or not is_next or code not in _KINDS or size > MAX_FRAME:
                raise _stranger(begin, is_next, code, size)
            at += HEAD_BYTES
            end = at + size
            if end <= filled:
                data = memoryview(bytearray(room[at:end]))
                self._close(NodeFrame(_KINDS[code], which, data), summed, urgent, number)
                at = end
                continue
            data, come = np.empty(size, dtype=np.uint8).data, filled - at
            data[:come] = room[at:filled]
            self._opened = NodeFrame(_KINDS[code], which, data), summed
            self._into, self._filled = data[come:], 0
            return
        if at < filled:
            room[: filled - at] = bytes(room[at:filled])
        if self._filled or at < filled:
            self._into = room[filled - at :]
        self._filled = filled - at

    def _close(
        self,
        frame: NodeFrame,
        summed: int,  # checksum in the head
        urgent: deque[tuple[int, NodeFrame]],
        number: int,  # number of the link
    ) -> None:
        """Check a complete frame, and queue it."""
        if xxh3_64_intdigest(frame.data) != summed:
            raise MessageError("the data of a frame are damaged")
        kind = frame.kind
        if kind not in _AT_ONCE:
            self.frames.append(frame)
        elif kind in URGENT:
            urgent.append((number, frame))
        elif number != COORDINATOR:
            raise MessageError(f"it must not send frames of kind {kind.name}")
        elif kind is FrameKind.END:
            raise NeededNoMoreError
        else:
            raise NodeRefusedError(f"the caller refuses this node: {_text(frame)}")


def _joined(pieces: Sequence[Bytes]) -> Bytes:
    """Join pieces; return a single piece without a copy."""
    if len(pieces) != 1:
        return b"".join(pieces)
    (data,) = pieces
    if isinstance(data, memoryview) and data.nbytes != len(data):
        return data.tobytes()
    return data


def _stranger(begin: bytes, is_next: bool, code: int, size: int) -> MessageError:
    """Return the error for a bad head."""
    version = int.from_bytes(begin[len(MAGIC) :], "little")
    if not begin.startswith(MAGIC):
        return MessageError(f"{begin[: len(MAGIC)]!r} does not start a frame of a node")
    if version != VERSION:
        return MessageError(
            f"a frame has version {version}, this process has {VERSION}: install the same cavmarl "
            "on all machines"
        )
    if not is_next:
        return MessageError("the head of a frame is damaged or out of order")
    if code not in _KINDS:
        return MessageError(f"a frame has the unknown kind {code}")
    return MessageError(f"a frame has {size} bytes, more than {MAX_FRAME}")


def read_list(frame: NodeFrame) -> list[Any]:
    """Read a JSON list. Raises MessageError: the frame has no JSON list."""
    try:
        found: list[Any] = read_json(frame.data, list)
    except MessageError as error:
        raise MessageError(f"a frame of kind {frame.kind.name}: {error}") from error
    return found


def _text(frame: NodeFrame) -> str:
    return bytes(frame.data).decode(errors="replace")
