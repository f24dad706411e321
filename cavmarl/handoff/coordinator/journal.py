"""The coordinator's write-ahead log on disk: decisions are stored before any zone receives them.

A line is a record of `ownership.log_records`. Lines are not buffered, and an append is one write.
So a process that dies leaves complete lines, and at most one incomplete line.
"""

from __future__ import annotations

import os
import sys
import weakref
from collections.abc import Iterable, Iterator
from io import FileIO
from pathlib import Path
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

    lines: int  # number of lines up to here; -1: there is no journal
    checksum: int  # checksum of the last of these lines, a signed word; 0 before the first line
    size: int  # size of these lines in bytes

    @classmethod
    def nowhere(cls) -> JournalPlace:
        """Return the place for worlds without a journal."""
        return cls(-1, 0, 0)

    def chain(self) -> LogChain:
        """Return the chain that writes the next line."""
        chain = LogChain()
        if self.lines:
            chain.sequence, chain.last = self.lines, f"{self.checksum & ((1 << 64) - 1):016x}"
        return chain


class JournalReader:
    """An iterator over the records of a file.

    Attributes:
        chain: the chain at the end of the complete lines that have been read.
        size: size of these lines in bytes.
        torn: a description of the incomplete last line that was dropped; empty: none.
    """

    def __init__(
        self,
        path: Path,
        *,
        # whether to drop an incomplete last line, which was never acted upon; if not, such a line
        # is an error
        drop_torn: bool = False,
    ) -> None:
        self.path = path
        self.chain, self.size, self.torn = LogChain(), 0, ""
        self._drop_torn = drop_torn

    @property
    def lines(self) -> int:
        """The number of complete lines that have been read."""
        return self.chain.sequence

    def __iter__(self) -> Iterator[Record]:
        """Yield the records, starting with the first line."""
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
            raise JournalError(
                f"{self.path}: {self.torn}; it was never acted upon, so read with drop_torn=True"
            )


def _open_to_append(path: str, flags: int) -> int:
    """Open a file whose writes go to its end, even after another process truncates it."""
    return os.open(path, flags | os.O_APPEND, 0o666)


class Journal:
    """A file to which one run at a time appends records.

    Attributes:
        dropped: a description of the incomplete line that was dropped; empty: none.
    """

    def __init__(
        self,
        path: Path,  # the file, which must not exist unless `resume` or `anew` is set
        *,
        # whether to append to an existing file; all its lines are read, and an incomplete last line
        # is dropped
        resume: bool = False,
        # whether to overwrite an existing file; the process that writes, possibly a fork of this
        # one, truncates the file when it writes its first line, or in `go_to`
        anew: bool = False,
        # where the lines are when an append returns; "flush": in the operating system, so that they
        # survive a crash of the process; "fsync": on disk, so that they survive a power failure
        sync: Sync = "flush",
    ) -> None:
        if sync not in get_args(Sync):
            raise ConfigError(f"sync = {sync!r}: must be one of {get_args(Sync)}")
        self.path = path
        self.dropped = ""
        self._chain = LogChain()
        self._size = 0  # size of the lines in bytes
        self._fsync = sync == "fsync"
        if resume and not path.is_file():
            raise JournalError(f"{path}: there is no such journal to resume; omit resume")
        try:
            self._file = FileIO(path, "ab" if resume or anew else "xb", opener=_open_to_append)
        except FileExistsError as error:
            raise JournalError(
                f"{path}: the journal exists already; resume it, or choose another path"
            ) from error
        except OSError as error:
            raise self._unwritable(error) from error
        # Callers may drop worlds without closing them; the journal is closed with its last
        # reference.
        weakref.finalize(self, self._file.close)
        self._pid = os.getpid()
        self._is_taken = not anew  # whether the writing process has prepared the file
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
        """The end of the journal."""
        word = int(self._chain.last or "0", 16)
        return JournalPlace(self.sequence, word - ((word >> 63) << 64), self._size)

    def go_to(self, place: JournalPlace) -> None:
        """Truncate the journal to an earlier end, and let this process append there.

        A process may continue the file of another process that has stopped writing.

        Raises:
            JournalError: the journal has no line that ends there.
        """
        chain = place.chain()
        try:
            if not self._has_ended(place, chain.last):
                raise JournalError(
                    f"{self.path}: line {place.lines} does not end at byte {place.size}, so this "
                    "is the journal of another run, or it has been changed; use the journal of "
                    "the saved state"
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
        """Append records. When this returns, messages about them may be sent."""
        if not self._is_taken:
            self.go_to(self.place)
        refuse_fork(self._pid, f"the lines of {self.path}")
        lines = [self._chain.write(record) for record in records]
        if not lines:
            return
        if self._file.closed:
            raise JournalError(f"{self.path}: the journal is closed; open it again to append")
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
        """Close the file. Closing it again does nothing."""
        self._file.close()

    def read(self) -> Iterator[Record]:
        """Return an iterator over all records. It raises the errors of `JournalReader`."""
        return iter(JournalReader(self.path))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _lock(self) -> None:
        """Lock the file against other writers while it is open."""
        if sys.platform == "win32":  # Windows has no fcntl
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
        """Truncate the file after the last complete line."""
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
            "free disk space there, or choose another path"
        )
