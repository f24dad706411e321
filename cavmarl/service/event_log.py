"""The event log of the service: events take effect at once and are acknowledged when on disk.

Events of concurrent requests are written in one transaction, with one wait for the disk.
"""

from __future__ import annotations

import asyncio
import hashlib
import time
from collections.abc import Callable
from typing import Any

from cavmarl.core.errors import ServiceError
from cavmarl.service.event_store import EventStore, digest_of
from cavmarl.service.service_records import Infrastructure, LogEvent

SERVICE = "service"


class EventLog:
    """The service records and the only way to change them.

    Args:
        store: where events are kept; the events that it holds are replayed.
        wall_s: the wall clock.

    Raises:
        ServiceError: the stored events were modified.
    """

    def __init__(self, store: EventStore, wall_s: Callable[[], float] = time.time) -> None:
        self.store = store
        self.state = Infrastructure()
        self.sequence = 0  # sequence number of the last event
        self.changed = asyncio.Condition()  # notified after each write and by `stir`
        self.is_broken = False
        self.wall_s = wall_s
        self._digest = ""
        self._lines: list[LogEvent] = []
        self._blobs: dict[str, bytes] = {}
        self._gone: list[str] = []
        self._in_flight: dict[str, bytes] = {}  # content that is being written
        self._writing = asyncio.Lock()
        self.durable = 0  # sequence number of the last event on disk
        for line in store.read_checked():
            self.state.apply(line)
            self.sequence, self._digest = line.sequence, line.digest
        self.durable = self.sequence

    def record(
        self,
        kind: str,
        subject: str,
        data: dict[str, Any] | None = None,
        *,
        actor: str = SERVICE,
        owner: str = "",
        private: dict[str, Any] | None = None,
    ) -> LogEvent:
        """Apply an event. It is on disk after the next `settle` or `flush`."""
        number, now_s = self.sequence + 1, self.wall_s()
        line = LogEvent(number, now_s, kind, actor, subject, owner, data or {}, private or {}, "")
        line = line._replace(digest=digest_of(self._digest, line))
        self.state.apply(line)
        self.sequence, self._digest = number, line.digest
        self._lines.append(line)
        return line

    def keep(self, content: bytes) -> str:
        """Store content together with the events that name it, and return its hash."""
        sha256 = hashlib.sha256(content).hexdigest()
        self._blobs[sha256] = content
        if sha256 in self._gone:
            self._gone.remove(sha256)
        return sha256

    def drop(self, sha256: str | None) -> None:
        """Delete content that no event needs any more."""
        if sha256 is not None:
            self._gone.append(sha256)

    def content(self, sha256: str) -> bytes:
        """Return stored content by its hash."""
        kept = self._blobs.get(sha256) or self._in_flight.get(sha256)
        found = kept or self.store.blob(sha256)
        if found is None:
            raise ServiceError(f"content {sha256[:12]}… is missing: the store is damaged")
        return found

    def flush(self) -> None:
        """Write all pending events."""
        self._write(*self._take())

    def _take(self) -> tuple[list[LogEvent], dict[str, bytes], list[str]]:
        """Return the events and content to write; call it in the thread that records events."""
        taken = self._lines, self._blobs, self._gone
        self._lines, self._blobs, self._gone, self._in_flight = [], {}, [], taken[1]
        return taken

    def _write(self, lines: list[LogEvent], blobs: dict[str, bytes], gone: list[str]) -> None:
        if not (lines or blobs or gone):
            return
        try:
            self.store.append(lines, blobs, gone)
        except ServiceError:
            self.is_broken = True  # memory is ahead of the disk: the service must be restarted
            raise
        if lines:
            self.durable = lines[-1].sequence

    async def settle(self) -> None:
        """Wait until all events recorded so far are on disk.

        Raises:
            ServiceError: they cannot be written; the service must end.
        """
        if not self._lines and not self._blobs and self.durable >= self.sequence:
            return
        async with self._writing:
            if self.is_broken:
                raise ServiceError(f"store {self.store.where}: cannot be written")
            if self._lines or self._blobs:
                await asyncio.to_thread(self._write, *self._take())
        await self.stir()

    async def stir(self) -> None:
        """Wake everything that waits for a change."""
        async with self.changed:
            self.changed.notify_all()
