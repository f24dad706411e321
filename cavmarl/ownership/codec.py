"""Conversion of messages to bytes and back: a header, the fields of the class, a checksum.

    4 bytes  "CVMO"      2 bytes  version      1 byte  kind      1 byte  zero
    the message's fields: integers of 8 bytes (digests of rows: 16), flags of 1 byte, byte strings
    and lists after their length in 4 bytes
    4 bytes  CRC-32 of all preceding bytes

All numbers are little-endian. Bytes in any other form are refused, never repaired.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import fields
from itertools import groupby
from operator import attrgetter
from typing import Any, get_args, get_origin, get_type_hints

from cavmarl.core.errors import MessageError
from cavmarl.ownership.ledger import OwnedTally
from cavmarl.ownership.messages import (
    RUN_BYTES,
    Abort,
    Ack,
    Done,
    Message,
    Nack,
    Need,
    Prepare,
    Step,
)

VERSION = 1
MAGIC = b"CVMO"
KINDS: tuple[type[Message], ...] = (Step, Done, Prepare, Ack, Nack, Abort, Need)

_HEADER = struct.Struct("<4sHBB")
_CRC = struct.Struct("<I")
_LENGTH = struct.Struct("<I")
_WIDE = frozenset({"rows", "digest"})  # sums of hashes: up to 16 bytes


def encode(message: Message) -> bytes:
    number = _NUMBER_OF[type(message)]
    plain = _PLAIN.get(number)
    if plain is not None and plain.fits(message):
        return plain.write(message)
    parts = [_HEADER.pack(MAGIC, VERSION, number, 0)]
    _FORMS[number].write(parts, message)
    body = b"".join(parts)
    return body + _CRC.pack(zlib.crc32(body))


def decode(
    data: bytes,  # one complete message
    run: bytes | None = None,  # run of the receiver; None: accept all runs
) -> Message:
    """Decode a message. Raises MessageError if it is damaged, or of another version or run."""
    if len(data) < _HEADER.size + _CRC.size:
        raise MessageError(f"a message of {len(data)} bytes is shorter than a header")
    magic, version, kind, zero = _HEADER.unpack_from(data)
    if magic != MAGIC:
        raise MessageError(f"a message begins with {MAGIC!r}, not with {magic!r}")
    if version != VERSION:
        raise MessageError(f"the message has version {version}, but this build reads {VERSION}")
    body = data[: -_CRC.size]
    if zlib.crc32(body) != _CRC.unpack_from(data, len(body))[0]:
        raise MessageError(f"the checksum of a message of {len(data)} bytes is wrong")
    if kind >= len(KINDS) or zero:
        raise MessageError(f"messages of kind {kind} do not exist")
    plain = _PLAIN.get(kind)
    message: Message | None = None if plain is None else plain.read(data)
    if message is None:
        message, at = _FORMS[kind].read(body, _HEADER.size)
        if at != len(body):
            raise MessageError(f"{len(body) - at} extra bytes follow the message")
    if run is not None and message.run != run:
        raise MessageError(f"the message is of run {message.run.hex()}, not of {run.hex()}")
    return message


class _Numbers:
    """Consecutive fields of fixed sizes: integers, flags, wide digests."""

    def __init__(self, hints: Sequence[tuple[str, Any]]) -> None:
        self._names = [name for name, _ in hints]
        self._whole = struct.Struct("<" + "".join(_letter(*hint) for hint in hints))
        self._wide = [n for n, hint in enumerate(hints) if _letter(*hint) == "16s"]
        self._few: list[tuple[int, Any, tuple[int, ...]]] = [
            (n, kind, (0, 1) if kind is bool else tuple(kind))
            for n, (_, kind) in enumerate(hints)
            if kind is not int
        ]

    def write(self, parts: list[bytes], value: Any) -> None:
        found = [getattr(value, name) for name in self._names]
        for n in self._wide:
            found[n] = found[n].to_bytes(16, "little")
        parts.append(self._whole.pack(*found))

    def read(self, body: bytes, at: int, values: list[Any]) -> int:
        """Append the fields to `values`. Return where they end."""
        end = at + self._whole.size
        if end > len(body):
            raise MessageError(f"a message ends inside fields of {self._whole.size} bytes")
        found = list(self._whole.unpack_from(body, at))
        for n in self._wide:
            found[n] = int.from_bytes(found[n], "little")
        for n, kind, known in self._few:
            if found[n] not in known:
                raise MessageError(f"{found[n]} is not one of {[int(value) for value in known]}")
            found[n] = kind(found[n])
        values += found
        return end


def _letter(name: str, kind: type[Any]) -> str:
    if kind is bool:
        return "B"
    return "16s" if kind is int and name in _WIDE else "q"


class _Bytes:
    """A field of bytes."""

    def __init__(self, name: str) -> None:
        self._name = name

    def write(self, parts: list[bytes], value: Any) -> None:
        data = getattr(value, self._name)
        parts += (_LENGTH.pack(len(data)), data)

    def read(self, body: bytes, at: int, values: list[Any]) -> int:
        size, at = _length(body, at)
        values.append(body[at : at + size])
        return at + size


class _List:
    """A list of entries of one class."""

    def __init__(self, name: str, kind: type[Any]) -> None:
        self._name = name
        self._form = _Form(kind, _entry_hints(kind))

    def write(self, parts: list[bytes], value: Any) -> None:
        entries = getattr(value, self._name)
        parts.append(_LENGTH.pack(len(entries)))
        for entry in entries:
            self._form.write(parts, entry)

    def read(self, body: bytes, at: int, values: list[Any]) -> int:
        number, at = _length(body, at)
        found = []
        for _ in range(number):
            entry, at = self._form.read(body, at)
            found.append(entry)
        values.append(tuple(found))
        return at


class _ListOfNumbers:
    """A list of integers."""

    def __init__(self, name: str) -> None:
        self._name = name

    def write(self, parts: list[bytes], value: Any) -> None:
        numbers = getattr(value, self._name)
        parts += (_LENGTH.pack(len(numbers)), struct.pack(f"<{len(numbers)}q", *numbers))

    def read(self, body: bytes, at: int, values: list[Any]) -> int:
        number, at = _length(body, at)
        if at + 8 * number > len(body):
            raise MessageError(f"a message ends inside a field of {8 * number} bytes")
        values.append(struct.unpack_from(f"<{number}q", body, at))
        return at + 8 * number


class _Entry:
    """A field that is an instance of another class."""

    def __init__(self, name: str, kind: type[Any]) -> None:
        self._name = name
        self._form = _Form(kind, _entry_hints(kind))

    def write(self, parts: list[bytes], value: Any) -> None:
        self._form.write(parts, getattr(value, self._name))

    def read(self, body: bytes, at: int, values: list[Any]) -> int:
        entry, at = self._form.read(body, at)
        values.append(entry)
        return at


class _Form:
    """The fields of a class, in their order. It is made once per class, to save time."""

    def __init__(self, kind: type[Any], hints: Sequence[tuple[str, Any]]) -> None:
        self._kind = kind
        self._parts: list[Any] = []
        for is_plain, some in groupby(hints, lambda hint: _is_plain(hint[1])):
            of_them = list(some)
            self._parts += [_Numbers(of_them)] if is_plain else [_part(*hint) for hint in of_them]

    def write(self, parts: list[bytes], value: Any) -> None:
        for part in self._parts:
            part.write(parts, value)

    def read(self, body: bytes, at: int) -> tuple[Any, int]:
        values: list[Any] = []
        for part in self._parts:
            at = part.read(body, at, values)
        return self._kind(*values), at


def _is_plain(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, int)


def _part(name: str, hint: Any) -> Any:
    if hint is bytes:
        return _Bytes(name)
    if get_origin(hint) is not tuple:
        return _Entry(name, hint)
    kind = get_args(hint)[0]
    return _ListOfNumbers(name) if kind is int else _List(name, kind)


def _length(body: bytes, at: int) -> tuple[int, int]:
    """Return the number of bytes or entries of a field, and where they begin."""
    begin = at + _LENGTH.size
    if begin > len(body):
        raise MessageError(f"a message ends inside a field of {_LENGTH.size} bytes")
    length: int = _LENGTH.unpack_from(body, at)[0]
    if length > len(body) - begin:
        raise MessageError(f"a field of {length} bytes or entries is incomplete")
    return length, begin


def _entry_hints(kind: type[Any]) -> tuple[tuple[str, Any], ...]:
    return tuple(get_type_hints(kind).items())


def _message_hints(kind: type[Message]) -> tuple[tuple[str, Any], ...]:
    hints = get_type_hints(kind)
    return tuple((field.name, hints[field.name]) for field in fields(kind))


class _Plain:
    """A STEP or DONE with empty lists only, converted at once.

    Most of these messages have this form. A conversion field by field takes four times as long.
    """

    def __init__(self, number: int, kind: type[Message]) -> None:
        self._begin = _HEADER.pack(MAGIC, VERSION, number, 0) + _LENGTH.pack(RUN_BYTES)
        self._kind = kind
        self._empty: list[tuple[int, Any]] = []  # indices of lists and bytes, with empty values
        self._wide: list[int] = []
        letters, names = f"{RUN_BYTES}s", ["run"]
        for name, hint in _message_hints(kind)[1:]:
            if hint is OwnedTally:
                self._owned = len(names)
                letters, names = letters + "q16s", [*names, "owned.vehicles", "owned.digest"]
                self._wide.append(len(names) - 1)
                continue
            if not _is_plain(hint):
                self._empty.append((len(names), hint() if hint is bytes else ()))
            elif name in _WIDE:
                self._wide.append(len(names))
            letters += _letter(name, hint) if _is_plain(hint) else _LENGTH.format[-1]
            names.append(name)
        self._numbers = struct.Struct("<" + letters)
        self._values = attrgetter(*names)
        self._lists = attrgetter(*(names[n] for n, _ in self._empty))
        self._size = len(self._begin) + self._numbers.size + _CRC.size

    def fits(self, message: Message) -> bool:
        return not any(self._lists(message)) and len(message.run) == RUN_BYTES

    def write(self, message: Message) -> bytes:
        values = list(self._values(message))
        for n, _ in self._empty:
            values[n] = 0
        for n in self._wide:
            values[n] = values[n].to_bytes(16, "little")
        body = self._begin + self._numbers.pack(*values)
        return body + _CRC.pack(zlib.crc32(body))

    def read(self, data: bytes) -> Message | None:
        """Read a message. Return None if it does not have this form."""
        if len(data) != self._size or not data.startswith(self._begin):
            return None
        values: list[Any] = list(self._numbers.unpack_from(data, len(self._begin)))
        for n, empty in self._empty:
            if values[n]:
                return None
            values[n] = empty
        for n in self._wide:
            values[n] = int.from_bytes(values[n], "little")
        at = self._owned
        values[at : at + 2] = [OwnedTally(*values[at : at + 2])]
        return self._kind(*values)


_FORMS = [_Form(kind, _message_hints(kind)) for kind in KINDS]
_NUMBER_OF = {kind: number for number, kind in enumerate(KINDS)}
_PLAIN = {_NUMBER_OF[kind]: _Plain(_NUMBER_OF[kind], kind) for kind in (Step, Done)}
