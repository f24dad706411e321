"""The coordinator's log on disk: what has been decided is there before it is told to any zone.

A line is a record of `ownership.log_records`. Nothing is kept in memory, and an append is one
write: a process that dies leaves whole lines, and at most one that is cut short.
"""

from __future__ import annotations

import os
import sys
import weakref
from collections.abc import Iterable, Iterator
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import Literal, NamedTuple, Self, TypeAlias, get_args

from cavmarl.core.errors import ConfigError, JournalError
from cavmarl.core.processes import refuse_fork
from cavmarl.ownership.log_records import LogChain
from cavmarl.ownership.messages import Record

if sys.platform != "win32":
    import fcntl

Sync: TypeAlias = Literal["flush", "fsync"]

_TAIL = '"checksum":"{}"}}\n'


class JournalPlace(NamedTuple):
    """The end of a line of a journal."""

    lines: int  # up to there
    checksum: int  # of the last of them, a signed word; 0 before the first
    size: int  # of these lines in bytes

    @classmethod
    def nowhere(cls) -> JournalPlace:
        """Of what has no journal."""
        return cls(-1, 0, 0)

    def chain(self) -> LogChain:
        """What writes the next line."""
        chain = LogChain()
        if self.lines:
            chain.sequence, chain.last = self.lines, f"{self.checksum & ((1 << 64) - 1):016x}"
        return chain


class JournalReader:
    """The records of a file, one after the other.

    Attributes:
        chain: where the whole lines end that have been read.
        size: bytes of them.
        torn: the number of the line that was dropped and how it begins, or nothing.
    """

    def __init__(
        self,
        path: Path,
        *,
        # whether a last line that is cut short ends the log instead of being an error: it was never
        # acted upon
        drop_torn: bool = False,
    ) -> None:
        self.path = path
        self.chain, self.size, self.torn = LogChain(), 0, ""
        self._drop_torn = drop_torn

    @property
    def lines(self) -> int:
        """Whole lines that have been read."""
        return self.chain.sequence

    def __iter__(self) -> Iterator[Record]:
        """From the first line on."""
        self.chain, self.size, self.torn = LogChain(), 0, ""
        try:
            with self.path.open("rb") as file:
                for line in file:
                    if not line.endswith(b"\n"):
                        self._end_torn(line)
                        return
                    yield self._record(line)
        except OSError as error:
            raise JournalError(f"{self.path}: cannot be read ({error.strerror})") from error

    def _record(self, line: bytes) -> Record:
        try:
            record = self.chain.read(line)
        except JournalError as error:
            raise JournalError(f"{self.path}: {error}") from error
        self.size += len(line)
        return record

    def _end_torn(self, line: bytes) -> None:
        self.torn = f"line {self.chain.sequence + 1} is cut short: {line[:40]!r}"
        if not self._drop_torn:
            raise JournalError(f"{self.path}: {self.torn}; it was never acted upon")


def _open_to_append(path: str, flags: int) -> int:
    """Open a file whose writes go to its end, also where it is cut off meanwhile."""
    return os.open(path, flags | os.O_APPEND, 0o666)


class Journal:
    """A file that records are appended to, by one run at a time.

    Attributes:
        dropped: the line that was dropped, or nothing.
    """

    def __init__(
        self,
        path: Path,  # of the file; without `resume` it must not exist
        *,
        # go on behind what is there. All of it is read, and a last line that is cut short is
        # dropped
        resume: bool = False,
        # the file may exist, and the first line or `go_to` cuts off what is in it: that is done by
        # the process that writes here, which may be a fork of this one
        anew: bool = False,
        # when an append returns, its lines have been given to the operating system ("flush"), so
        # that they outlive the process, or have been written out ("fsync"), so that they outlive
        # the machine
        sync: Sync = "flush",
    ) -> None:
        if sync not in get_args(Sync):
            raise ConfigError(f"sync is {sync!r}: it has to be one of {get_args(Sync)}")
        self.path = path
        self.dropped = ""
        self._chain = LogChain()
        self._size = 0  # of the lines
        self._fsync = sync == "fsync"
        if resume and not path.is_file():
            raise JournalError(f"{path}: is no file to go on with; begin one without resume")
        try:
            self._file = FileIO(path, "ab" if resume or anew else "xb", opener=_open_to_append)
        except FileExistsError as error:
            raise JournalError(
                f"{path}: exists; go on with it (resume), or choose another path"
            ) from error
        except OSError as error:
            raise self._unwritable(error) from error
        # Worlds are not closed: their journal is, when it is not referenced any more.
        weakref.finalize(self, self._file.close)
        self._pid = os.getpid()
        self._is_taken = not anew  # by the process that writes
        try:
            self._lock()
            if resume:
                self._read()
        except JournalError:
            self._file.close()
            raise

    @property
    def sequence(self) -> int:
        """The number of the next line."""
        return self._chain.sequence

    @property
    def place(self) -> JournalPlace:
        """Where it ends."""
        word = int(self._chain.last or "0", 16)
        return JournalPlace(self.sequence, word - ((word >> 63) << 64), self._size)

    def go_to(self, place: JournalPlace) -> None:
        """Cut off what follows a place where it has ended before; this process goes on from there.

        For a process that has taken over the file of another one, which writes no more.

        Raises:
            JournalError: it has never ended there.
        """
        chain = place.chain()
        try:
            if not self._has_ended(place, chain.last):
                raise JournalError(
                    f"{self.path}: has no line {place.lines} that ends at byte {place.size}; it is "
                    "the journal of another run, or has been changed"
                )
            os.truncate(self.path, place.size)
        except OSError as error:
            raise self._unwritable(error) from error
        self._chain, self._size = chain, place.size
        self._pid, self._is_taken = os.getpid(), True

    def _has_ended(self, place: JournalPlace, checksum: str) -> bool:
        if place.lines <= 0:
            return place == JournalPlace(0, 0, 0)
        tail = _TAIL.format(checksum).encode()
        with self.path.open("rb") as file:
            file.seek(max(place.size - len(tail), 0))
            return file.read(len(tail)) == tail

    def append(self, records: Iterable[Record]) -> None:
        """Write records down; when it returns, messages may be sent."""
        if not self._is_taken:
            self.go_to(self.place)
        refuse_fork(self._pid, f"the lines of {self.path}")
        lines = [self._chain.write(record) for record in records]
        if not lines:
            return
        if self._file.closed:
            raise JournalError(f"{self.path}: the journal is closed")
        left = memoryview("".join(lines).encode())
        try:
            while left:
                written = self._file.write(left)
                left, self._size = left[written:], self._size + written
            if self._fsync:
                os.fsync(self._file.fileno())
        except OSError as error:
            self._file.close()
            raise self._unwritable(error) from error

    def close(self) -> None:
        """Close the file; once more does nothing."""
        self._file.close()

    def read(self) -> Iterator[Record]:
        """What has been written, from the first line on; errors as of `JournalReader`."""
        return iter(JournalReader(self.path))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _lock(self) -> None:
        """Keep all others from writing here, as long as the file is open."""
        if sys.platform == "win32":  # an open file can be shared there, by an unknown process
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise JournalError(
                f"{self.path}: another run is writing this journal; choose another path, or wait "
                "until it has ended"
            ) from error
        except OSError as error:
            raise self._unwritable(error) from error

    def _read(self) -> None:
        """Find the end of what is there, and cut off what follows it."""
        reader = JournalReader(self.path, drop_torn=True)
        for _ in reader:
            pass
        self._chain, self.dropped, self._size = reader.chain, reader.torn, reader.size
        if self.dropped:
            try:
                os.truncate(self.path, reader.size)
            except OSError as error:
                raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> JournalError:
        return JournalError(
            f"{self.path}: the journal cannot be written ({error.strerror}); "
            "make room there, or choose another path"
        )
