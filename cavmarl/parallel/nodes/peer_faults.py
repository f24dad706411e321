"""What is wrong with a frame is its sender's fault: the sender is lost, and the run goes on."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, JournalError, MessageError, ProtocolError

FAULTS = (
    ProtocolError, ConfigError, ValueError, TypeError, LookupError, ArithmeticError,
    AttributeError, RecursionError, MemoryError, struct.error,
)  # fmt: skip


class LinkLostError(Exception):
    """A connection has ended, or what came over it cannot be."""

    def __init__(self, peer: int, cause: Exception | None = None) -> None:
        why = f": {cause}" if isinstance(cause, MessageError) else ""
        super().__init__(f"the connection to node {peer} has ended{why}")
        self.peer = peer


class reading:
    """The time in which a frame of a peer is read and checked.

    Raises:
        LinkLostError: anything has failed meanwhile, but the journal.
    """

    __slots__ = ("_peer",)

    def __init__(self, peer: int) -> None:
        self._peer = peer

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, FAULTS) and not isinstance(error, JournalError):
            if not isinstance(error, MessageError):
                error = MessageError(f"what it sent cannot be read: {error!r}")
            raise LinkLostError(self._peer, error) from error


def check_indices(what: str, found: Iterable[int] | NDArray[Any], count: int) -> None:
    """Refuse what is no index of a table with so many rows, before anything is looked up by it.

    Raises:
        MessageError: one of them is no whole number, or out of range.
    """
    if isinstance(found, np.ndarray):
        if found.size and not 0 <= int(found.min()) <= int(found.max()) < count:
            raise MessageError(f"it names a {what} that there is not: there are {count}")
        return
    for index in found:
        if type(index) is not int or not 0 <= index < count:
            raise MessageError(f"it names {what} {index!r}: there are {count}")


def read_json(data: memoryview | bytes, kind: type[Any]) -> Any:
    """What a part of a frame says. Raises MessageError: it is no JSON, or says something else."""
    try:
        said = json.loads(bytes(data))
    except (ValueError, RecursionError) as error:
        raise MessageError(f"it is no JSON: {error}") from error
    if not isinstance(said, kind):
        raise MessageError(f"it says {said!r}")
    return said
