"""Messages of CARLA's RPC connections: msgpack objects, one after another.

A request is `[0, number, name, [metadata, argument, ...]]`, an answer `[1, number, error, result]`.
Messages of other kinds are ignored.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from cavmarl.core.errors import MessageError, require

_msgpack: Any = require("msgpack", "carla")

_MAX_LIST = 1 << 16  # longest array in a message
_REQUEST, _ANSWER = 0, 1


class Request(NamedTuple):
    """A call of a client."""

    number: int
    name: str
    arguments: list[Any]  # without the metadata


class RequestReader:
    """Splits the bytes of one connection into requests.

    `max_bytes`: largest size of a message, and of the bytes that wait for the rest of a message.
    """

    def __init__(self, max_bytes: int) -> None:
        self._unpacker = _msgpack.Unpacker(
            raw=False,
            unicode_errors="replace",
            strict_map_key=False,
            max_buffer_size=max_bytes,
            max_array_len=min(_MAX_LIST, max_bytes),
            max_map_len=0,
            max_ext_len=0,
        )

    def read(self, data: bytes) -> Iterator[Request]:
        """Yield the requests that are complete after `data` has arrived.

        Raises MessageError: the bytes are not requests, or a message is too large. The connection
        is then unusable.
        """
        try:
            self._unpacker.feed(data)
            for message in self._unpacker:
                request = _request_of(message)
                if request is not None:
                    yield request
        except (_msgpack.exceptions.UnpackException, ValueError) as error:
            problem = str(error) or type(error).__name__
            raise MessageError(f"not a request of CARLA's client: {problem}") from error


def _request_of(message: Any) -> Request | None:
    if not isinstance(message, list) or not message or not isinstance(message[0], int):
        raise ValueError(f"a message is {type(message).__name__} and not an array with a kind")
    if message[0] != _REQUEST:
        return None
    match message:
        case [_, int(number), str(name), [_, *arguments]]:
            return Request(number, name, arguments)
    raise ValueError("a request must have a number, a name and arguments with metadata")


def pack_answer(number: int, error: str | None, result: Any) -> bytes:
    """Return the bytes of an answer."""
    answer: bytes = _msgpack.packb([_ANSWER, number, error, result])
    return answer


def pack(value: Any) -> bytes:
    """Return the bytes of a value, for the bodies of some sensors."""
    packed: bytes = _msgpack.packb(value)
    return packed


def value_answer(value: Any) -> list[Any]:
    """Return the result of a call that returns a value."""
    return [[1, value]]


def failed_value(message: str) -> list[Any]:
    """Return the result of a failed call that should return a value."""
    return [[0, [message]]]


def nothing_answer() -> list[Any]:
    """Return the result of a call that returns nothing."""
    return [[False]]


def failed_nothing(message: str) -> list[Any]:
    """Return the result of a failed call that returns nothing."""
    return [[True, [message]]]
