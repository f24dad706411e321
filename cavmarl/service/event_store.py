"""The event store: an append-only table of events, and content identified by its hash.

It uses SQLite with a write-ahead log, or PostgreSQL. When `append` returns, its data are on disk.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import threading
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

from sqlalchemy import (
    BigInteger,
    Column,
    Float,
    Index,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    create_engine,
    delete,
    event,
    insert,
    inspect,
    select,
    text,
)
from sqlalchemy.engine import URL, RootTransaction, make_url
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, SQLAlchemyError

from cavmarl.core.errors import CavmarlError, ServiceError, require
from cavmarl.core.private_files import check_private
from cavmarl.service.service_records import LogEvent
from cavmarl.service.snapshots import SealedSnapshot

SCHEMA = "cavmarl.service/2"
_LOCK_KEY = 0x6361766D  # key of PostgreSQL's advisory lock
_PAGE = 1000  # lines that one query reads
# PostgreSQL ends the connection, and so the lock, of a machine that does not answer for 4 s. After
# the same time, the service ends its connection to a machine of PostgreSQL that does not answer.
_DEAD_PEERS = {
    "options": "-c tcp_keepalives_idle=1 -c tcp_keepalives_interval=1 -c tcp_keepalives_count=3 "
    "-c tcp_user_timeout=4000",
    "keepalives_idle": 1,
    "keepalives_interval": 1,
    "keepalives_count": 3,
    "tcp_user_timeout": 4000,
}

_METADATA = MetaData()
_ABOUT = Table("about", _METADATA, Column("schema", String(64), primary_key=True))
_EVENTS = Table(
    "events",
    _METADATA,
    Column("sequence", BigInteger, primary_key=True, autoincrement=False),
    Column("time_s", Float(53), nullable=False),
    Column("kind", String(64), nullable=False),
    Column("actor", String(64), nullable=False),
    Column("subject", String(128), nullable=False),
    Column("owner", String(64), nullable=False),
    Column("data", Text, nullable=False),
    Column("private", Text, nullable=False),
    Column("digest", String(64), nullable=False),
)
_INDICES = [
    Index(f"events_of_{name}", _EVENTS.c[name], _EVENTS.c.sequence)
    for name in ("owner", "actor", "subject")
]
_BLOBS = Table(
    "blobs",
    _METADATA,
    Column("sha256", String(64), primary_key=True),
    Column("content", LargeBinary, nullable=False),
)
_HEAD = Table(
    "head",
    _METADATA,
    Column("sequence", BigInteger, primary_key=True, autoincrement=False),
    Column("digest", String(64), nullable=False),
    Column("key", String(64), nullable=False),
    Column("seal", String(64), nullable=False),
)
_SNAPSHOT = Table(
    "snapshot",
    _METADATA,
    Column("sequence", BigInteger, primary_key=True, autoincrement=False),
    Column("digest", String(64), nullable=False),
    Column("schema", String(128), nullable=False),
    Column("key", String(64), nullable=False),
    Column("content", Text, nullable=False),
    Column("seal", String(64), nullable=False),
)


class SignedHead(NamedTuple):
    """The end of the log, sealed with the service's key."""

    sequence: int  # number of events
    digest: str  # digest of the last event
    key: str  # id of the key
    seal: str  # HMAC-SHA256 of the other fields


def digest_of(before: str, line: LogEvent) -> str:
    """Return the digest of a line, which includes the digest of the previous line."""
    content = json.dumps([before, *line[:-1]], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(content.encode()).hexdigest()


class EventStore:
    """A store that only this process writes.

    Args:
        where: an SQLite file, or the URL of a database.
        is_standby: whether another service may own the store until `try_lock` returns true.

    Raises:
        ServiceError: the store cannot be opened, is in use by another service, or has another
            version.
        ConfigError: other users can read its file.
    """

    def __init__(self, where: str | Path, *, is_standby: bool = False) -> None:
        self._lock: IO[bytes] | None = None
        self._open = ExitStack()
        self._guard = threading.Lock()  # guards the only connection
        self.url = url = _url_of(str(where))
        self.where = url.render_as_string() if "://" in str(where) else str(where)  # no password
        self.is_embedded = url.get_backend_name() == "sqlite"
        if self.is_embedded and is_standby:
            raise ServiceError(
                f"store {self.where}: two services cannot share an SQLite file; with --standby, "
                "give --store postgresql://…"
            )
        if self.is_embedded:
            self._lock = _lock_file(Path(str(url.database)))
        try:
            given = {} if self.is_embedded else _DEAD_PEERS
            engine = create_engine(url, pool_size=1, max_overflow=0, connect_args=given)
            self._open.callback(engine.dispose)
            if self.is_embedded:
                event.listen(engine, "connect", _make_durable)
            self._connection = self._open.enter_context(engine.connect())
            if not is_standby:
                if not self.is_embedded and not self._take_advisory_lock():
                    raise _taken(self.where)
                self._check_schema()
        except SQLAlchemyError as error:
            self.close()
            cause = str(getattr(error, "orig", error)).strip().splitlines()[0]
            raise ServiceError(
                f"store {self.where}: cannot be opened ({cause}); check that its "
                "folder or server exists and can be written"
            ) from error
        except ServiceError:
            self.close()
            raise

    def try_lock(self) -> bool:
        """Return whether this standby owns the store from now on.

        The lock of another service ends with its connection.

        Raises:
            ServiceError: the connection is lost, or the store has another version.
        """
        try:
            if not self._take_advisory_lock():
                return False
            self._check_schema()
        except SQLAlchemyError as error:
            raise self._lost(error) from error
        return True

    def has_tables(self) -> bool:
        """Return whether a service has prepared the store."""
        try:
            with self._guard, self._begin():
                return set(_METADATA.tables) <= set(inspect(self._connection).get_table_names())
        except SQLAlchemyError as error:
            raise self._lost(error) from error

    def check_lock(self) -> None:
        """Check that this process still owns the store.

        Raises:
            ServiceError: the connection, and with it the lock, is lost; the service must end.
        """
        if self.is_embedded:
            return
        try:
            with self._guard, self._begin():
                self._connection.execute(text("SELECT 1"))
        except SQLAlchemyError as error:
            raise self._lost(error) from error

    def _begin(self) -> RootTransaction:
        """Begin a transaction; a lost connection is never replaced, as its lock is lost, too."""
        if self._connection.invalidated:
            raise self._lost("the connection was lost")
        return self._connection.begin()

    def _lost(self, cause: object) -> ServiceError:
        shown = str(getattr(cause, "orig", cause)).strip().splitlines()[0]
        return ServiceError(
            f"store {self.where}: its server does not answer ({shown}), so another service may "
            "have the store; check the server, and start this service again"
        )

    def append(
        self,
        lines: Sequence[LogEvent],
        blobs: dict[str, bytes],
        gone: Collection[str] = (),
        head: SignedHead | None = None,
        snapshot: SealedSnapshot | None = None,
    ) -> None:
        """Write the given data, and delete the content `gone`, in one transaction.

        A head or a snapshot replaces the earlier one.

        Raises:
            ServiceError: the store cannot be written; nothing was changed.
        """
        with self._writing():
            if lines:
                self._connection.execute(insert(_EVENTS), [_row(line) for line in lines])
            for sha256, content in blobs.items():
                there = select(_BLOBS.c.sha256).where(_BLOBS.c.sha256 == sha256)
                if self._connection.execute(there).scalar() is None:
                    row = {"sha256": sha256, "content": content}
                    self._connection.execute(insert(_BLOBS), row)
            if head is not None:
                self._connection.execute(delete(_HEAD))
                self._connection.execute(insert(_HEAD), head._asdict())
            if snapshot is not None:
                self._connection.execute(delete(_SNAPSHOT))
                self._connection.execute(insert(_SNAPSHOT), snapshot._asdict())
            if gone:
                self._connection.execute(delete(_BLOBS).where(_BLOBS.c.sha256.in_(gone)))

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Run the code inside in one transaction; raise ServiceError if it cannot be written."""
        try:
            with self._guard, self._begin():
                yield
        except SQLAlchemyError as error:
            raise ServiceError(
                f"store {self.where}: cannot be written ({getattr(error, 'orig', error)}); nothing "
                "was changed; free disk space and restart the service"
            ) from error

    def read(
        self,
        after: int = 0,
        limit: int | None = None,
        *,
        until: int | None = None,  # the last sequence number
        owner: str | None = None,  # the owner of the subject, or the identity that caused the event
        subject: str | None = None,
    ) -> Iterator[LogEvent]:
        """Return the lines after a sequence number, of all subjects or of some."""
        wanted = []
        if until is not None:
            wanted.append(_EVENTS.c.sequence <= until)
        if owner is not None:
            wanted.append((_EVENTS.c.owner == owner) | (_EVENTS.c.actor == owner))
        if subject is not None:
            wanted.append(_EVENTS.c.subject == subject)
        left = limit
        while left is None or left > 0:
            size = _PAGE if left is None else min(left, _PAGE)
            query = select(_EVENTS).where(_EVENTS.c.sequence > after, *wanted)
            ordered = query.order_by(_EVENTS.c.sequence).limit(size)
            with self._guard, self._begin():
                rows = list(self._connection.execute(ordered))
            for row in rows:
                yield _line(row)
            if len(rows) < size:
                return
            after = rows[-1].sequence
            left = None if left is None else left - len(rows)

    def blob(self, sha256: str) -> bytes | None:
        """Return the content with this hash."""
        query = select(_BLOBS.c.content).where(_BLOBS.c.sha256 == sha256)
        with self._guard, self._begin():
            found = self._connection.execute(query).scalar()
        return found if isinstance(found, bytes) else None

    def head(self) -> SignedHead | None:
        """Return the head that was written with the last line."""
        with self._guard, self._begin():
            row = self._connection.execute(select(_HEAD)).one_or_none()
        return None if row is None else SignedHead(**row._asdict())

    def snapshot(self) -> SealedSnapshot | None:
        """Return the newest snapshot, which is not checked yet."""
        query = select(_SNAPSHOT).order_by(_SNAPSHOT.c.sequence.desc()).limit(1)
        with self._valid("its snapshot"), self._guard, self._begin():
            row = self._connection.execute(query).one_or_none()
        return None if row is None else SealedSnapshot(*row)

    def drop_snapshot(self) -> None:
        """Delete the snapshot."""
        with self._writing():
            self._connection.execute(delete(_SNAPSHOT))

    def read_checked(
        self, after: int = 0, digest: str = "", until: int | None = None
    ) -> Iterator[LogEvent]:
        """Return lines after checking the chain of their digests.

        Args:
            after: number of the line before the first one.
            digest: digest of that line.
            until: number of the last line; None: all.

        Raises:
            ServiceError: a line was changed, removed or inserted.
        """
        last = digest
        for count, line in enumerate(self.read_valid(after, until=until), start=after + 1):
            if line.sequence != count or line.digest != digest_of(last, line):
                raise ServiceError(
                    f"store {self.where}: event {line.sequence} does not follow from the "
                    "previous one: the log was modified; restore an older copy"
                )
            last = line.digest
            yield line

    def read_valid(self, after: int = 0, **wanted: Any) -> Iterator[LogEvent]:
        """Like `read`, but raise ServiceError if a line cannot be read."""
        with self._valid("an event"):
            yield from self.read(after, **wanted)

    @contextmanager
    def _valid(self, what: str) -> Iterator[None]:
        try:
            yield
        except (SQLAlchemyError, TypeError, ValueError) as error:
            if self._connection.invalidated:
                raise self._lost(error) from error
            raise ServiceError(
                f"store {self.where}: {what} cannot be read ({error}): the log was modified; "
                "restore an older copy"
            ) from error

    def close(self) -> None:
        """Release the store."""
        self._open.close()
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _check_schema(self) -> None:
        connection = self._connection
        with connection.begin():
            there = set(inspect(connection).get_table_names())
            if "about" not in there and there & set(_METADATA.tables):
                raise _foreign(self.where, "none")
            _METADATA.create_all(connection)
            for index in _INDICES:
                index.create(connection, checkfirst=True)
            found = connection.execute(select(_ABOUT.c.schema)).scalar()
            if found is None:
                connection.execute(insert(_ABOUT), {"schema": SCHEMA})
            elif found != SCHEMA:
                raise _foreign(self.where, found)

    def _take_advisory_lock(self) -> bool:
        with self._guard, self._begin():
            query = text("SELECT pg_try_advisory_lock(:key)")
            return bool(self._connection.execute(query, {"key": _LOCK_KEY}).scalar())


def _url_of(where: str) -> URL:
    if "://" not in where:
        return _file_url(URL.create("sqlite", database=where))
    try:
        url = make_url(where)
        if url.get_backend_name() == "postgresql":
            require("psycopg", "service")
            return url.set(drivername="postgresql+psycopg")
        url.get_dialect()
    except (ArgumentError, NoSuchModuleError) as error:
        raise ServiceError(f"store: {error}; give an SQLite file or postgresql://…") from error
    if url.get_backend_name() != "sqlite":
        raise ServiceError(
            f"store {url.render_as_string()}: must be an SQLite file or postgresql://…"
        )
    return _file_url(url)


def _file_url(url: URL) -> URL:
    """Return the URL of an SQLite file; refuse databases in memory, which end with the process."""
    if url.database in (None, "", ":memory:") or url.query:
        raise ServiceError(
            f"store {url.render_as_string()}: must be a file, as a service continues from its "
            "store after a restart; give the path of an SQLite file"
        )
    return url.set(drivername="sqlite")


def _lock_file(path: Path) -> IO[bytes]:
    """Return the opened file of the store, locked as long as this process has the store.

    The lock belongs to the file itself, so it holds for all its names.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)  # it contains keys
    except OSError as error:
        raise ServiceError(f"store {path}: cannot be opened ({error.strerror})") from error
    lock = os.fdopen(handle, "r+b")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if (names := os.fstat(handle).st_nlink) > 1:  # SQLite names its log after one of the names
            raise ServiceError(f"store {path}: has {names} names; remove its other hard links")
        check_private("store", path)
    except BlockingIOError:
        lock.close()
        raise _taken(str(path)) from None
    except CavmarlError:
        lock.close()
        raise
    return lock


def _taken(where: str) -> ServiceError:
    return ServiceError(
        f"store {where}: is in use by another service; end that service, or give another --store"
    )


def _foreign(where: str, schema: str) -> ServiceError:
    return ServiceError(
        f"store {where}: has schema {schema}, this version needs {SCHEMA}; give another --store"
    )


def _make_durable(connection: Any, _: Any) -> None:
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=FULL")  # a commit survives a crash of the machine
    cursor.close()


def _row(line: LogEvent) -> dict[str, Any]:
    row = line._asdict()
    return row | {name: json.dumps(row[name], sort_keys=True) for name in ("data", "private")}


def _line(row: Any) -> LogEvent:
    *values, data, private, digest = row
    return LogEvent._make([*values, json.loads(data), json.loads(private), digest])
