"""The event log of the service: events take effect at once and are acknowledged when on disk.

Events of concurrent requests are written in one transaction, with one wait for the disk.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import time
from collections.abc import Callable
from typing import Any

from cavmarl.core.errors import ServiceError
from cavmarl.service.error_names import problem
from cavmarl.service.event_store import EventStore, SignedHead, digest_of
from cavmarl.service.service_records import Infrastructure, LogEvent

SERVICE = "service"
_Batch = tuple[list[LogEvent], dict[str, bytes], set[str], SignedHead | None]


class EventLog:
    """The service records and the only way to change them.

    Args:
        store: where events are kept; the events that it holds are replayed.
        wall_s: the wall clock.
        is_own: whether the store is that of this process; a standby calls `catch_up` until it is.

    Raises:
        ServiceError: the stored events were modified.
    """

    def __init__(
        self,
        store: EventStore,
        wall_s: Callable[[], float] = time.time,
        *,
        is_own: bool = True,
    ) -> None:
        self.store = store
        self.state = Infrastructure()
        self.sequence = 0  # sequence number of the last event
        self.changed = asyncio.Condition()  # notified after each write and by `stir`
        self.is_broken = False
        self.wall_s = wall_s
        self._digest = ""
        self._lines: list[LogEvent] = []
        self._blobs: dict[str, bytes] = {}
        self._gone: set[str] = set()
        self._in_flight: dict[str, bytes] = {}  # content that is being written
        self._writing = asyncio.Lock()
        self.durable = 0  # sequence number of the last event on disk
        self.catch_up()
        if is_own:
            self.check_head()

    def catch_up(self) -> int:
        """Apply the events that another service has written since; return their number."""
        before = self.sequence
        for line in self.store.read_checked(before, self._digest):
            try:
                self.state.apply(line)
            except Exception as error:
                raise ServiceError(
                    f"store {self.store.where}: event {line.sequence} contradicts earlier ones "
                    f"({error!r}): the log was modified; restore an older copy"
                ) from error
            self.sequence, self._digest = line.sequence, line.digest
        self.durable = self.sequence
        self.state.take_unused()  # it was deleted with the events that made it unused
        return self.sequence - before

    def check_head(self) -> None:
        """Check that the stored head is that of the events; raise ServiceError if it is not."""
        if self.store.head() != self._signed_head():
            raise ServiceError(
                f"store {self.store.where}: its signed head is not that of its events: the log was "
                "modified; restore an older copy"
            )

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
        self._gone |= self.state.take_unused()
        return line

    def keep(self, content: bytes) -> str:
        """Store content together with the events that name it, and return its hash."""
        sha256 = hashlib.sha256(content).hexdigest()
        self._blobs[sha256] = content
        self._gone.discard(sha256)
        return sha256

    def content(self, sha256: str) -> bytes:
        """Return stored content by its hash.

        Raises:
            ServiceError: the content is missing or was changed.
        """
        found = self._blobs.get(sha256, self._in_flight.get(sha256))
        if found is None:
            found = self.store.blob(sha256)
        if found is None or hashlib.sha256(found).hexdigest() != sha256:
            what = "is missing" if found is None else "does not have its hash"
            raise problem("damaged", f"content {sha256[:12]}… {what}: the store was changed")
        return found

    def flush(self) -> None:
        """Write all pending events."""
        self._write(*self._take())

    def _take(self) -> _Batch:
        """Return what is to be written; call it in the thread that records events."""
        taken = self._lines, self._blobs, self._gone, self._signed_head()
        self._lines, self._blobs, self._gone, self._in_flight = [], {}, set(), taken[1]
        return taken

    def _signed_head(self) -> SignedHead | None:
        """Return the head of all events so far."""
        if not self.sequence:
            return None
        if not self.state.keys:
            raise ServiceError(
                f"store {self.store.where}: has no signing key: the log was modified"
            )
        key, pem = next(reversed(self.state.keys.items()))
        content = json.dumps(["head of the log", self.sequence, self._digest, key])
        seal = hmac.digest(pem.encode(), content.encode(), "sha256").hex()
        return SignedHead(self.sequence, self._digest, key, seal)

    def _write(
        self,
        lines: list[LogEvent],
        blobs: dict[str, bytes],
        gone: set[str],
        head: SignedHead | None,
    ) -> None:
        if not (lines or blobs or gone):
            return
        try:
            self.store.append(lines, blobs, gone, head)
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
