"""The event log of the service: events take effect at once and are acknowledged when on disk.

Events of concurrent requests are written in one transaction, with one wait for the disk. A log
continues from a snapshot of the records, if there is one, and checks the events before it later.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import time
from collections.abc import Callable, Iterator
from typing import Any

from cavmarl.core.errors import ServiceError
from cavmarl.service.error_names import problem
from cavmarl.service.event_store import EventStore, SignedHead, digest_of
from cavmarl.service.service_records import Infrastructure, LogEvent
from cavmarl.service.snapshots import (
    SNAPSHOT_EVENTS,
    SNAPSHOT_SCHEMA,
    SealedSnapshot,
    is_same,
    records_of,
    text_of,
)

SERVICE = "service"
KEY = "key.added"
_Batch = tuple[list[LogEvent], dict[str, bytes], set[str], SignedHead | None, SealedSnapshot | None]


class EventLog:
    """The records of the service, and the only way to change them.

    Args:
        store: where events are kept. The events after its snapshot are replayed; call
            `check_older` to check the events before the snapshot.
        wall_s: the wall clock.
        is_own: whether this process owns the store; a standby calls `catch_up` until it owns it.
        snapshot_events: events after which a snapshot is written; 0: use and write none.

    Attributes:
        origin: what the records were made from, as text.
        failure: why the service must end: events cannot be written, or a check has failed.

    Raises:
        ServiceError: the stored events or their snapshot were modified.
    """

    def __init__(
        self,
        store: EventStore,
        wall_s: Callable[[], float] = time.time,
        *,
        is_own: bool = True,
        snapshot_events: int = SNAPSHOT_EVENTS,
    ) -> None:
        self.store = store
        self.state = Infrastructure()
        self.sequence = 0  # sequence number of the last event
        self.failure: ServiceError | None = None
        self.changed = asyncio.Condition()  # notified after each write and by `stir`
        self.wall_s = wall_s
        self._digest = ""
        self._lines: list[LogEvent] = []
        self._blobs: dict[str, bytes] = {}
        self._gone: set[str] = set()
        self._in_flight: dict[str, bytes] = {}  # content that is being written
        self._writing = asyncio.Lock()
        self.durable = 0  # sequence number of the last event on disk
        self._snapshot_events = snapshot_events
        self._older: Iterator[None] = iter(())  # the check of the events before the snapshot
        self.origin = self._continue_from_snapshot() if snapshot_events else "no snapshot is used"
        self._snapshot_at = self.sequence  # sequence number of the last event before the snapshot
        later = self.catch_up()
        self.origin += f", {later} {'later ' if self._snapshot_at else ''}events replayed"
        if is_own:
            self.check_head()

    def catch_up(self) -> int:
        """Apply the events that another service has written since; return their number."""
        before = self.sequence
        for line in self._replayed(self.state, before, self._digest):
            self.sequence, self._digest = line.sequence, line.digest
        self.durable = self.sequence
        self.state.take_unused()  # the writer of the events has deleted unused content
        return self.sequence - before

    def _replayed(
        self, state: Infrastructure, after: int, digest: str, until: int | None = None
    ) -> Iterator[LogEvent]:
        """Check and apply stored events, and yield each after it was applied."""
        for line in self.store.read_checked(after, digest, until):
            try:
                state.apply(line)
            except Exception as error:
                raise ServiceError(
                    f"store {self.store.where}: event {line.sequence} contradicts earlier ones "
                    f"({error!r}): the log was modified; restore an older copy"
                ) from error
            yield line

    def _continue_from_snapshot(self) -> str:
        """Take the records from the snapshot if it can be used; return what was done.

        Raises:
            ServiceError: this service has not written the snapshot for this log.
        """
        found = self.store.snapshot()
        if found is None:
            return "without a snapshot"
        self._check_snapshot(found)
        if found.schema != SNAPSHOT_SCHEMA:  # only after the check of the seal
            return f"without the snapshot, which is of another version ({found.schema})"
        self.state = records_of(found.content)
        self.sequence, self._digest = found.sequence, found.digest
        self._older = self._check_events_of(found)
        return f"snapshot after event {found.sequence}"

    def _check_snapshot(self, found: SealedSnapshot) -> None:
        keys = self.store.read_valid(subject=found.key)
        sealed = {found.sealed(str(one.private.get("pem"))) for one in keys if one.kind == KEY}
        if found not in sealed:
            why = "is not sealed with a key of this log"
        elif found.digest not in self._digests(found.sequence):
            why = f"follows an event {found.sequence} that this log does not have"
        else:
            return
        raise ServiceError(
            f"store {self.store.where}: its snapshot {why}: the store was modified; restore an "
            "older copy, or replay and check all events with --snapshot-events 0, which deletes "
            "the snapshot"
        )

    def _digests(self, number: int) -> list[str]:
        """Return the digest of a stored event, or nothing if there is no such event."""
        return [one.digest for one in self.store.read_valid(number - 1, until=number)]

    def _check_events_of(self, snapshot: SealedSnapshot) -> Iterator[None]:
        """Replay the events before a snapshot, and compare the records with the snapshot."""
        state, digest = Infrastructure(), ""
        for line in self._replayed(state, 0, "", snapshot.sequence):
            digest = line.digest
            yield
        if digest != snapshot.digest or not is_same(state, records_of(snapshot.content)):
            raise ServiceError(
                f"store {self.store.where}: its first {snapshot.sequence} events do not give the "
                "records of its snapshot: the store was modified; restore an older copy"
            )

    def check_older(self, for_s: float) -> bool:
        """Go on checking the events before the snapshot; return whether all of them are checked.

        A thread may call this while events are recorded.

        Args:
            for_s: time after which to return.

        Raises:
            ServiceError: the events were modified, or do not give the records of the snapshot.
        """
        until_s = time.monotonic() + for_s
        return all(time.monotonic() < until_s for _ in self._older)

    def check_head(self) -> None:
        """Raise ServiceError if the stored head does not match the events."""
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

    def end(self) -> None:
        """Write all pending events, and a snapshot for the next start."""
        self._write(*self._take(is_last=True))

    def _take(self, *, is_last: bool = False) -> _Batch:
        """Return the pending batch of writes; call it in the thread that records events."""
        taken = self._lines, self._blobs, self._gone, self._signed_head(), self._snapshot(is_last)
        self._lines, self._blobs, self._gone, self._in_flight = [], {}, set(), taken[1]
        return taken

    def _snapshot(self, is_last: bool) -> SealedSnapshot | None:
        """Return a snapshot of the records if it is due or this is the last batch."""
        new = self.sequence - self._snapshot_at
        if not self._snapshot_events or new < (1 if is_last else self._snapshot_events):
            return None
        self._snapshot_at = self.sequence
        key, pem = next(reversed(self.state.keys.items()))
        found = SealedSnapshot(
            self.sequence, self._digest, SNAPSHOT_SCHEMA, key, text_of(self.state), ""
        )
        return found.sealed(pem)

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
        snapshot: SealedSnapshot | None,
    ) -> None:
        if not (lines or blobs or gone or snapshot):
            return
        try:
            self.store.append(lines, blobs, gone, head, snapshot)
        except ServiceError as error:
            self.failure = error  # memory is ahead of the disk: the service must be restarted
            raise
        if lines:
            self.durable = lines[-1].sequence

    async def settle(self) -> None:
        """Wait until all events recorded so far are on disk.

        Raises:
            ServiceError: the events cannot be written; the service must end.
        """
        if not self._lines and not self._blobs and self.durable >= self.sequence:
            return
        async with self._writing:
            if self.failure is not None:
                raise ServiceError(f"store {self.store.where}: cannot be written")
            if self._lines or self._blobs:
                await asyncio.to_thread(self._write, *self._take())
        await self.stir()

    async def stir(self) -> None:
        """Wake everything that waits for a change."""
        async with self.changed:
            self.changed.notify_all()
