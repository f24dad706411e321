"""Messages as bytes: a header, the fields in the order of the class, a checksum.

    4 bytes  "CVMO"      2 bytes  version      1 byte  kind      1 byte  zero
    the message's fields: whole numbers of 8 bytes (digests of rows: 16), flags of 1 byte,
    byte strings and lists with their length in 4 bytes before them
    4 bytes  CRC-32 of all that precedes

All numbers are little-endian. What is not exactly so is refused, never repaired.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import fields
from enum import IntEnum
from typing import Any, get_args, get_origin, get_type_hints

from cavmarl.core.errors import MessageError
from cavmarl.ownership.messages import Abort, Ack, Done, Message, Nack, Need, Prepare, Step

VERSION = 1
MAGIC = b"CVMO"
KINDS: tuple[type[Message], ...] = (Step, Done, Prepare, Ack, Nack, Abort, Need)

_HEADER = struct.Struct("<4sHBB")
_CRC = struct.Struct("<I")
_LENGTH = struct.Struct("<I")
_NUMBER = struct.Struct("<q")
_WIDE = frozenset({"rows", "digest"})  # sums of hashes: up to 16 bytes


def encode(message: Message) -> bytes:
    parts = [_HEADER.pack(MAGIC, VERSION, KINDS.index(type(message)), 0)]
    for name, hint in _HINTS[type(message)]:
        _write(parts, name, hint, getattr(message, name))
    body = b"".join(parts)
    return body + _CRC.pack(zlib.crc32(body))


def decode(
    data: bytes,  # one whole message
    run: bytes | None = None,  # of the receiver; None accepts all
) -> Message:
    """The message of a wire form."""
    if len(data) < _HEADER.size + _CRC.size:
        raise MessageError(f"a message of {len(data)} bytes has no room for its header")
    magic, version, kind, zero = _HEADER.unpack_from(data)
    if magic != MAGIC:
        raise MessageError(f"a message begins with {MAGIC!r}, not with {magic!r}")
    if version != VERSION:
        raise MessageError(f"version {version} of the messages; known is {VERSION}")
    body = data[: -_CRC.size]
    if zlib.crc32(body) != _CRC.unpack_from(data, len(body))[0]:
        raise MessageError(f"the checksum of a message of {len(data)} bytes is wrong")
    if kind >= len(KINDS) or zero:
        raise MessageError(f"kind {kind} of message does not exist")
    reader = _Reader(body)
    values = {name: reader.value(name, hint) for name, hint in _HINTS[KINDS[kind]]}
    if reader.at != len(body):
        raise MessageError(f"{len(body) - reader.at} bytes follow after the message")
    if run is not None and values["run"] != run:
        raise MessageError(f"a message of run {values['run'].hex()}; this is {run.hex()}")
    message: Message = KINDS[kind](**values)
    return message


def _write(parts: list[bytes], name: str, hint: Any, value: Any) -> None:
    if hint is bytes:
        parts += (_LENGTH.pack(len(value)), value)
    elif hint is bool:
        parts.append(b"\1" if value else b"\0")
    elif hint is int and name in _WIDE:
        parts.append(value.to_bytes(16, "little"))
    elif isinstance(hint, type) and issubclass(hint, int):
        parts.append(_NUMBER.pack(value))
    elif get_origin(hint) is tuple:
        parts.append(_LENGTH.pack(len(value)))
        for entry in value:
            _write(parts, name, get_args(hint)[0], entry)
    else:
        for field, inner in _entry_hints(hint):
            _write(parts, field, inner, getattr(value, field))


class _Reader:
    """Reads fields from the body of a message, from its header on."""

    def __init__(self, body: bytes) -> None:
        self.at = _HEADER.size
        self._body = body

    def value(self, name: str, hint: Any) -> Any:
        if hint is bytes:
            return self._take(self._length())
        if hint is bool:
            return self._one_of(self._take(1)[0], (0, 1), bool)
        if hint is int and name in _WIDE:
            return int.from_bytes(self._take(16), "little")
        if isinstance(hint, type) and issubclass(hint, int):
            number = _NUMBER.unpack(self._take(_NUMBER.size))[0]
            return self._one_of(number, tuple(hint), hint) if issubclass(hint, IntEnum) else number
        if get_origin(hint) is tuple:
            inner = get_args(hint)[0]
            return tuple(self.value(name, inner) for _ in range(self._length()))
        return hint(*(self.value(field, inner) for field, inner in _entry_hints(hint)))

    def _length(self) -> int:
        length: int = _LENGTH.unpack(self._take(_LENGTH.size))[0]
        if length > len(self._body) - self.at:
            raise MessageError(f"a field of {length} bytes or entries is cut short")
        return length

    def _take(self, size: int) -> bytes:
        if self.at + size > len(self._body):
            raise MessageError(f"a message ends inside a field of {size} bytes")
        self.at += size
        return self._body[self.at - size : self.at]

    def _one_of(self, number: int, known: tuple[int, ...], make: Callable[[int], Any]) -> Any:
        if number not in known:
            raise MessageError(f"{number} is none of {[int(value) for value in known]}")
        return make(number)


_ENTRIES: dict[type[Any], tuple[tuple[str, Any], ...]] = {}


def _entry_hints(kind: type[Any]) -> tuple[tuple[str, Any], ...]:
    if kind not in _ENTRIES:
        _ENTRIES[kind] = tuple(get_type_hints(kind).items())
    return _ENTRIES[kind]


def _message_hints(kind: type[Message]) -> tuple[tuple[str, Any], ...]:
    hints = get_type_hints(kind)
    return tuple((field.name, hints[field.name]) for field in fields(kind))


_HINTS = {kind: _message_hints(kind) for kind in KINDS}
