"""`Link`: a connection over which whole frames go.

A frame is a head of fixed size and bytes. Frames of a connection arrive in their order, or the
connection has ended. Nothing in a frame is ever run.

    head    magic, version, kind, number, bytes of what follows, checksum of what follows,
            checksum of the head

Checksums are XXH3 of 64 bits; they guard against accidents alone. The seed of the head's is how
many frames went before on that connection, so that one that comes twice or out of turn is no frame.
It is compared before anything else of the frame is awaited.
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
from cavmarl.parallel.network.transport import MOST_PIECES, Bytes, Connection
from cavmarl.parallel.nodes.peer_faults import read_json

MAGIC = b"cavN"
VERSION = 7
MAX_FRAME = 1 << 32
_ALL = (1 << 64) - 1
BEGIN = MAGIC + VERSION.to_bytes(2, "little")
_HEAD = struct.Struct("<6sHQQQ")
SUMMED = _HEAD.size  # bytes of a head that its checksum is of
_SUM = struct.Struct("<Q")
_WHOLE_HEAD = struct.Struct("<6sHQQQQ")
HEAD_BYTES = _WHOLE_HEAD.size
ROOM = 1 << 14  # bytes that are read at once where it is not known what comes


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


class NodeFrame(NamedTuple):
    """A frame that has come."""

    kind: FrameKind
    number: int  # which of its kind, as both ends count
    data: memoryview


_KINDS = {int(kind): kind for kind in FrameKind}
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
_AT_ONCE = URGENT | {FrameKind.END, FrameKind.REFUSED}  # not kept until they are taken


class NeededNoMoreError(Exception):
    """The coordinator says that this node may end."""


class Link:
    """One connection: what is to be sent, and what has come of the next frame."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.waiting: deque[memoryview] = deque()
        self.frames: deque[NodeFrame] = deque()
        self._room = memoryview(bytearray(ROOM))  # what has come, until it is known what it is
        self._filled = 0  # bytes of it
        self._into = self._room  # where the next bytes go: there, or into a frame that has begun
        self._opened: tuple[NodeFrame, int] | None = None  # that frame, and its checksum
        self._num_sent = self._num_received = 0  # frames

    def send(self, kind: FrameKind, number: int, pieces: Sequence[Bytes]) -> int:
        """Send what the connection takes at once; the rest is kept, as a copy.

        Returns:
            bytes of the frame.
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
        """Take what has come; urgent frames are added to those of others, with a number each.

        Raises:
            EOFError, OSError: the other end has gone.
            MessageError: what came is no frame.
            NeededNoMoreError, NodeRefusedError: the coordinator has said its last word.
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
        """Take the frames that begin in what has come."""
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
        summed: int,  # its checksum, as the head has it
        urgent: deque[tuple[int, NodeFrame]],
        number: int,
    ) -> None:
        """Take a frame that has come whole."""
        if xxh3_64_intdigest(frame.data) != summed:
            raise MessageError("a frame is not what was sent")
        kind = frame.kind
        if kind not in _AT_ONCE:
            self.frames.append(frame)
        elif kind in URGENT:
            urgent.append((number, frame))
        elif kind is FrameKind.END:
            raise NeededNoMoreError
        else:
            raise NodeRefusedError(f"the caller refuses this node: {_text(frame)}")


def _joined(pieces: Sequence[Bytes]) -> Bytes:
    """Pieces as one; a single one is not copied."""
    if len(pieces) != 1:
        return b"".join(pieces)
    (data,) = pieces
    if isinstance(data, memoryview) and data.nbytes != len(data):
        return data.tobytes()
    return data


def _stranger(begin: bytes, is_next: bool, code: int, size: int) -> MessageError:
    """Why a head is none."""
    version = int.from_bytes(begin[len(MAGIC) :], "little")
    if not begin.startswith(MAGIC):
        return MessageError(f"{begin[: len(MAGIC)]!r} begins no frame of a node")
    if version != VERSION:
        return MessageError(
            f"a frame of version {version}, this is {VERSION}: install the same cavmarl everywhere"
        )
    if not is_next:
        return MessageError("a frame's head is not what was sent, or not the next one")
    return MessageError(f"a frame of kind {code} with {size} bytes is none")


def read_list(frame: NodeFrame) -> list[Any]:
    """A list as JSON. Raises MessageError: it is none."""
    try:
        found: list[Any] = read_json(frame.data, list)
    except MessageError as error:
        raise MessageError(f"a frame of kind {frame.kind.name}: {error}") from error
    return found


def _text(frame: NodeFrame) -> str:
    return bytes(frame.data).decode(errors="replace")
