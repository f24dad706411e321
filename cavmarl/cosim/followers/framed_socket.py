"""`FramedSocket`: frames over a connection.

A frame has three parts: a head of fixed size; a payload, mostly a few numbers, encoded as the
dialect defines; and data, the bytes of arrays whose shapes both ends know. A frame contains numbers
and text, never code.

    head    magic, version, kind, order, bytes of the payload, bytes of the data,
            checksum of the data, checksum of the head and the payload
    payload may be empty
    data    the arrays one after another, as in memory (little-endian)
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

MAX_PIECES = 512  # maximum number of buffers in one system call

_HEAD = struct.Struct("<4sHHQIQI")
_SUM = struct.Struct("<I")
HEAD_BYTES = _HEAD.size + _SUM.size


class Dialect(NamedTuple):
    """The parameters of a protocol, which are equal at both ends of a connection."""

    magic: bytes  # the first four bytes of every frame
    version: int  # version of the protocol
    kinds: type[IntEnum]  # kinds of frames
    max_payload: int  # maximum size of a payload in bytes
    max_data: int  # maximum size of the data in bytes
    write: Callable[[Any], bytes]  # encodes a payload
    read: Callable[[bytes], Any]  # decodes a payload; raises ValueError if it is invalid
    cure: str  # advice if the other end has another version


class Frame(NamedTuple):
    """A received frame without its data."""

    kind: IntEnum  # kind of the frame
    order: int  # a number that each dialect uses as it likes; messages of followers have 0
    payload: Any  # as decoded by the dialect; None: empty
    size: int  # size of the data in bytes
    checksum: int  # checksum of the data


class FramedSocket:
    """One end of a connection; each call blocks, at most for the timeout of the socket."""

    def __init__(
        self,
        connection: socket.socket,  # a stream socket, which this object owns and closes
        dialect: Dialect,  # the same at both ends
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
        """Send one frame. Raises OSError: the connection is lost, or the peer does not read."""
        dialect = self._dialect
        text = b"" if payload is None else dialect.write(payload)
        data = [array.data.cast("B") for array in arrays if array.nbytes]
        checksum = _checksum(data)
        size = sum(len(piece) for piece in data)
        head = _HEAD.pack(dialect.magic, dialect.version, kind, order, len(text), size, checksum)
        start = b"".join((head, _SUM.pack(zlib.crc32(text, zlib.crc32(head))), text))
        self._send_all([memoryview(start), *data])

    def receive(self) -> Frame:
        """Return the next frame without its data, which must then be taken or skipped.

        Raises:
            EOFError: the other end has closed the connection.
            OSError: the connection is lost, or nothing arrives in time.
            MessageError: the frame is damaged, or is not a frame of the dialect.
        """
        dialect = self._dialect
        raw = self._read(HEAD_BYTES)
        head = bytes(raw[: _HEAD.size])
        kind, order, payload_size, size, checksum = _parse_head(head, dialect)
        text = bytes(self._read(payload_size))
        if _SUM.unpack(raw[_HEAD.size :])[0] != zlib.crc32(text, zlib.crc32(head)):
            raise MessageError("the head of a frame does not match its checksum")
        self._frame = _parse_frame(dialect, kind, order, text, size, checksum)
        return self._frame

    def take(
        self,
        arrays: Sequence[Array],  # contiguous arrays, filled one after the other
    ) -> None:
        """Read the data of the received frame into arrays.

        Raises:
            EOFError: the other end has closed the connection.
            OSError: the connection is lost, or the data do not arrive in time.
            MessageError: the data are damaged, or do not have the size of the arrays.
        """
        frame = self._frame
        assert frame is not None
        pieces = [array.data.cast("B") for array in arrays if array.nbytes]
        room = sum(len(piece) for piece in pieces)
        if room != frame.size:
            raise MessageError(f"a frame has {frame.size} bytes of data; {room} are expected")
        for piece in pieces:
            self._fill(piece)
        if frame.checksum != _checksum(pieces):
            raise MessageError("the data of a frame do not match their checksum")
        self._frame = None

    def skip(self) -> None:
        """Read the data of the received frame, and discard them."""
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
    """Return the size of a frame's head and payload in bytes, given its first HEAD_BYTES.

    Raises MessageError: these bytes do not begin a frame of the dialect.
    """
    return HEAD_BYTES + _parse_head(head[: _HEAD.size], dialect)[2]


def _parse_head(head: bytes, dialect: Dialect) -> tuple[int, int, int, int, int]:
    """Return kind, order, size of the payload, size and checksum of the data."""
    magic, version, kind, order, payload_size, size, checksum = _HEAD.unpack(head)
    if magic != dialect.magic:
        raise MessageError(f"{head[:4]!r} does not begin a frame")
    if version != dialect.version:
        raise MessageError(
            f"a frame has version {version}, this end has {dialect.version}: {dialect.cure}"
        )
    if payload_size > dialect.max_payload or size > dialect.max_data:
        raise MessageError(f"a frame of {payload_size} + {size} bytes is too large")
    return kind, order, payload_size, size, checksum


def _parse_frame(
    dialect: Dialect, kind: int, order: int, text: bytes, size: int, checksum: int
) -> Frame:
    """Return a frame from its numbers and the bytes of its payload."""
    try:
        payload = dialect.read(text) if text else None
        return Frame(dialect.kinds(kind), order, payload, size, checksum)
    except ValueError as error:
        raise MessageError(f"a frame has an invalid kind or payload: {error}") from error


def _checksum(pieces: Sequence[memoryview]) -> int:
    found = 0
    for piece in pieces:
        found = zlib.crc32(piece, found)
    return found
