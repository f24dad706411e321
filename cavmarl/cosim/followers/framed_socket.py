"""`FramedSocket`: frames over a connection.

A frame is a head of fixed size, a payload (mostly a few numbers, encoded as the dialect defines)
and data (bytes of arrays, whose shapes both ends know). A frame carries numbers and text, never
code.

    head    magic, version, kind, order, bytes of the payload, bytes of the data,
            checksum of the data, checksum of the head and the payload
    payload nothing if there is nothing to say
    data    arrays one behind the other, as they lie in memory (little-endian)
"""

from __future__ import annotations

import socket
import struct
import zlib
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MessageError

Array = NDArray[Any]

MAX_PIECES = 512  # buffers in one call of the system

_HEAD = struct.Struct("<4sHHQIQI")
_SUM = struct.Struct("<I")
HEAD_BYTES = _HEAD.size + _SUM.size


class Dialect(NamedTuple):
    """What both ends of a connection agree on."""

    magic: bytes  # four bytes that every frame begins with
    version: int  # of everything that is said
    kinds: type[IntEnum]  # of frames
    max_payload: int  # bytes of the longest payload
    max_data: int  # bytes of the most data
    write: Callable[[Any], bytes]  # a payload's bytes
    read: Callable[[bytes], Any]  # the payload again; a ValueError says that it is none
    cure: str  # what to do about another version


class Frame(NamedTuple):
    """What stands before a frame's data."""

    kind: IntEnum  # what it says
    order: int  # which order it belongs to
    payload: Any  # as the dialect reads it; None: nothing
    size: int  # bytes of data
    checksum: int  # of them


class FramedSocket:
    """One end of a connection; each call blocks, at most for the timeout of the socket."""

    def __init__(
        self,
        connection: socket.socket,  # a stream socket, which this object owns and closes
        dialect: Dialect,  # that both ends use
    ) -> None:
        if connection.family != socket.AF_UNIX:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = connection
        self._dialect = dialect
        self._frame: Frame | None = None

    def fileno(self) -> int:
        return self._socket.fileno()

    def send(
        self, kind: IntEnum, order: int, payload: Any = None, arrays: Sequence[Array] = ()
    ) -> None:
        """Send one frame. Raises OSError: the other end is gone, or does not read."""
        dialect = self._dialect
        text = b"" if payload is None else dialect.write(payload)
        data = [array.data.cast("B") for array in arrays if array.nbytes]
        checksum = _checksum(data)
        size = sum(len(piece) for piece in data)
        head = _HEAD.pack(dialect.magic, dialect.version, kind, order, len(text), size, checksum)
        start = b"".join((head, _SUM.pack(zlib.crc32(text, zlib.crc32(head))), text))
        self._send_all([memoryview(start), *data])

    def receive(self) -> Frame:
        """What stands before the next frame's data, which then has to be taken or skipped.

        Raises:
            EOFError: the other end has ended.
            OSError: it is gone, or sends nothing.
        """
        dialect = self._dialect
        raw = self._read(HEAD_BYTES)
        head = bytes(raw[: _HEAD.size])
        kind, order, payload_size, size, checksum = _understood(head, dialect)
        text = bytes(self._read(payload_size))
        if _SUM.unpack(raw[_HEAD.size :])[0] != zlib.crc32(text, zlib.crc32(head)):
            raise MessageError("the head of a frame is not what was sent")
        self._frame = _frame(dialect, kind, order, text, size, checksum)
        return self._frame

    def take(
        self,
        arrays: Sequence[Array],  # contiguous; they are filled one after the other
    ) -> None:
        """Read the data of the frame that was received.

        Raises:
            EOFError: the other end has ended.
            OSError: it is gone, or sends no more.
        """
        frame = self._frame
        assert frame is not None
        pieces = [array.data.cast("B") for array in arrays if array.nbytes]
        room = sum(len(piece) for piece in pieces)
        if room != frame.size:
            raise MessageError(f"{frame.size} bytes of data: {room} were to come")
        for piece in pieces:
            self._fill(piece)
        if frame.checksum != _checksum(pieces):
            raise MessageError("the data of a frame are not what was sent")
        self._frame = None

    def skip(self) -> None:
        """Read the data of the frame that was received, and forget them."""
        assert self._frame is not None
        self.take([np.empty(self._frame.size, dtype=np.uint8)])

    def close(self) -> None:
        self._socket.close()

    def _send_all(self, pieces: list[memoryview]) -> None:
        while pieces:
            sent = self._socket.sendmsg(pieces[:MAX_PIECES])
            while pieces and sent >= len(pieces[0]):
                sent -= len(pieces.pop(0))
            if sent:
                pieces[0] = pieces[0][sent:]

    def _read(self, size: int) -> bytearray:
        raw = bytearray(size)
        self._fill(memoryview(raw))
        return raw

    def _fill(self, piece: memoryview) -> None:
        while piece:
            got = self._socket.recv_into(piece)
            if not got:
                raise EOFError("the connection has ended")
            piece = piece[got:]


def bytes_before_data(head: bytes, dialect: Dialect) -> int:
    """How long a frame's head and payload are together, by its first HEAD_BYTES.

    Raises MessageError: no frame of the dialect begins so.
    """
    return HEAD_BYTES + _understood(head[: _HEAD.size], dialect)[2]


def _understood(head: bytes, dialect: Dialect) -> tuple[int, int, int, int, int]:
    """Kind, order, bytes of the payload, bytes and checksum of the data."""
    magic, version, kind, order, payload_size, size, checksum = _HEAD.unpack(head)
    if magic != dialect.magic:
        raise MessageError(f"{head[:4]!r} begins no frame")
    if version != dialect.version:
        raise MessageError(
            f"a frame of version {version}, this is {dialect.version}: {dialect.cure}"
        )
    if payload_size > dialect.max_payload or size > dialect.max_data:
        raise MessageError(f"a frame of {payload_size} + {size} bytes is none")
    return kind, order, payload_size, size, checksum


def _frame(dialect: Dialect, kind: int, order: int, text: bytes, size: int, checksum: int) -> Frame:
    """The same, understood."""
    try:
        payload = dialect.read(text) if text else None
        return Frame(dialect.kinds(kind), order, payload, size, checksum)
    except ValueError as error:
        raise MessageError(f"a frame that says nothing: {error}") from error


def _checksum(pieces: Sequence[memoryview]) -> int:
    found = 0
    for piece in pieces:
        found = zlib.crc32(piece, found)
    return found
