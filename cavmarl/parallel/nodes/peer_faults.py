"""Faults of peers: the sender of a bad frame counts as lost, and the run goes on."""

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
    """A connection has ended, or has carried a bad frame.

    Attributes:
        peer: the process at the other end.
        fault: reason why the frame is bad; empty if the connection has ended.
    """

    def __init__(self, peer: int, cause: Exception | None = None) -> None:
        self.fault = str(cause) if isinstance(cause, MessageError) else ""
        why = f": {self.fault}" if self.fault else ""
        super().__init__(f"the connection to node {peer} has ended{why}")
        self.peer = peer


class reading:
    """Context in which a frame of a peer is read and checked.

    Raises:
        LinkLostError: the code inside has raised one of `FAULTS` other than a JournalError.
    """

    __slots__ = ("_peer",)

    def __init__(self, peer: int) -> None:
        self._peer = peer

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, FAULTS) and not isinstance(error, JournalError):
            if not isinstance(error, MessageError):
                error = MessageError(f"one of its frames cannot be read: {error!r}")
            raise LinkLostError(self._peer, error) from error


def check_indices(what: str, found: Iterable[int] | NDArray[Any], count: int) -> None:
    """Check indices into a table with `count` rows before they are used.

    Raises:
        MessageError: an index is not a whole number, or is out of range.
    """
    if isinstance(found, np.ndarray):
        if found.size and not 0 <= int(found.min()) <= int(found.max()) < count:
            raise MessageError(f"it names a {what} out of range: there are {count}")
        return
    for index in found:
        if type(index) is not int or not 0 <= index < count:
            raise MessageError(f"it names {what} {index!r}: there are {count}")


def read_json(data: memoryview | bytes, kind: type[Any]) -> Any:
    """Read a JSON value of a type from a frame. Raises MessageError if the type differs."""
    try:
        value = json.loads(bytes(data))
    except (ValueError, RecursionError) as error:
        raise MessageError(f"it is not JSON: {error}") from error
    if not isinstance(value, kind):
        raise MessageError(f"it has {value!r} in place of a {kind.__name__}")
    return value
