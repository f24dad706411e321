"""`BoundedHeads`: HTTP connections with limits on the length and the time of request heads."""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

MAX_HEAD_BYTES = 16 * 1024
HEAD_S = 10.0  # time limit of a request head, and of what follows an answered request


class BoundedHeads(HttpToolsProtocol):
    """HTTP that closes connections with long or slow request heads; uvicorn itself accepts them.

    The limit of the length applies to everything except bodies, so trailers count. An application
    limits the time of the body that it reads; the time of a body that it did not read is limited
    here.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._begin_head()

    def data_received(self, data: bytes) -> None:
        if self._late is None and self.cycle is not None and self.cycle.response_complete:
            self._begin_head()
        self._head_bytes += len(data)
        super().data_received(data)
        if self._head_bytes > MAX_HEAD_BYTES:
            self.transport.close()

    def on_message_begin(self) -> None:
        super().on_message_begin()
        self._end_head()
        self._begin_head()

    def on_headers_complete(self) -> None:
        self._end_head()
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        self._head_bytes -= len(body)
        super().on_body(body)

    def on_chunk_header(self) -> None:
        self._head_bytes = 0

    def connection_lost(self, exc: Exception | None) -> None:
        self._end_head()
        super().connection_lost(exc)

    def _begin_head(self) -> None:
        self._head_bytes = 0
        self._late = self.loop.call_later(HEAD_S, self.transport.close)

    def _end_head(self) -> None:
        if self._late is not None:
            self._late.cancel()
            self._late = None

    _late: asyncio.TimerHandle | None = None
    _head_bytes = 0
