"""The stream port: a client names a stream, and then receives the frames of that stream.

A frame is sent only if a client listens to its stream. Unread frames wait in this process. While
the world runs freely, a client with waiting frames gets no more of them. If the world is
synchronous, no frame is left out, and a client with too many waiting bytes is dropped.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
from collections.abc import Callable

log = logging.getLogger("cavmarl.carla")

EPISODE_STREAM = 1
_STREAM = struct.Struct("<I")
_TOKEN = struct.Struct("<IHBB16x")
_TCP, _HOST_NOT_SET = 1, 0  # protocol, and kind of address: the client uses the host of the RPC
_WAITING_BYTES = 1 << 20  # a client with more bytes gets no frames while the world runs freely


class StreamHub:
    """The clients that listen to each stream.

    Args:
        port: port of the streams.
        max_unsent: largest number of bytes that wait for one client.
        max_listeners: largest number of connections.

    Attributes:
        first_frames: makes the head and the body that a new listener of a stream gets at once.
    """

    def __init__(self, port: int, max_unsent: int = 1 << 26, max_listeners: int = 4096) -> None:
        self.port = port
        self.max_unsent, self.max_listeners = max_unsent, max_listeners
        self.connections: set[StreamConnection] = set()
        self._listeners: dict[int, set[StreamConnection]] = {}
        self.first_frames: dict[int, Callable[[], tuple[bytes, bytes]]] = {}

    def token(self, stream: int) -> bytes:
        """Return the bytes with which a client finds a stream."""
        return _TOKEN.pack(stream, self.port, _TCP, _HOST_NOT_SET)

    def is_wanted(self, stream: int) -> bool:
        return bool(self._listeners.get(stream))

    def send(self, stream: int, head: bytes, body: bytes, keep: bool) -> None:
        """Send a frame to all listeners of a stream.

        `keep`: whether a slow client also gets the frame; see the module.
        """
        frame = _packed(head, body)
        for connection in list(self._listeners.get(stream, ())):
            connection.send(frame, keep, self.max_unsent)

    def listen(self, stream: int, connection: StreamConnection) -> None:
        self._listeners.setdefault(stream, set()).add(connection)
        if stream in self.first_frames:
            connection.send(_packed(*self.first_frames[stream]()), True, self.max_unsent)

    def forget(self, stream: int, connection: StreamConnection) -> None:
        listeners = self._listeners.get(stream, set())
        listeners.discard(connection)
        if not listeners:
            self._listeners.pop(stream, None)

    def end(self, stream: int) -> None:
        """Close the connections of a stream."""
        for connection in list(self._listeners.pop(stream, ())):
            connection.close()

    def close(self) -> None:
        """Close all connections."""
        for connection in list(self.connections):
            connection.close()


def _packed(head: bytes, body: bytes) -> bytes:
    return _STREAM.pack(len(head) + len(body)) + head + body


class StreamConnection(asyncio.Protocol):
    """One connection to the stream port."""

    def __init__(self, hub: StreamHub) -> None:
        self._hub = hub
        self._name = b""
        self._stream: int | None = None
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        without_delay(transport)
        if len(self._hub.connections) >= self._hub.max_listeners:
            log.warning("a stream connection is refused: %d are open", self._hub.max_listeners)
            transport.abort()
            return
        self._hub.connections.add(self)

    def data_received(self, data: bytes) -> None:
        if self._stream is not None:
            return  # a client only reads after it has named a stream
        self._name += data
        if len(self._name) >= _STREAM.size:
            (self._stream,) = _STREAM.unpack_from(self._name)
            self._name = b""
            self._hub.listen(self._stream, self)

    def connection_lost(self, exc: Exception | None) -> None:
        self._hub.connections.discard(self)
        if self._stream is not None:
            self._hub.forget(self._stream, self)

    def send(self, frame: bytes, keep: bool, max_unsent: int) -> None:
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        waiting = transport.get_write_buffer_size()
        if waiting > _WAITING_BYTES and not keep:
            return
        if waiting + len(frame) > max_unsent + _WAITING_BYTES:
            log.warning(
                "a client of stream %s does not read: %d bytes wait; its connection is closed",
                self._stream,
                waiting,
            )
            transport.abort()
            return
        transport.write(frame)

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()


def without_delay(transport: asyncio.Transport) -> None:
    """Send small messages at once."""
    connection = transport.get_extra_info("socket")
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
