"""Conversion of log records to JSON lines and back.

A line is an object with the keys `schema` ("cavmarl.ownership/5"), `sequence` (0, 1, 2, …),
`kind` (RESET, BEGIN, COMMIT, FENCE, HOST), `episode`, `tick`, the fields of that kind, and
`checksum`. The checksum is BLAKE2b of 8 bytes, in hex, over the checksum of the previous line, if
any, and the line without the key `checksum`. So lines of another log are detected. Bytes and the
digests of rows and sets are in hex. A list of entries is a list of lists.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import partial
from hashlib import blake2b
from typing import Any, get_args, get_origin, get_type_hints

from cavmarl.core.errors import JournalError
from cavmarl.ownership.messages import Begin, Commit, Fence, Host, Record, Reset
from cavmarl.ownership.table import Table

SCHEMA = "cavmarl.ownership/5"
KINDS: dict[str, type[Record]] = {
    "RESET": Reset,
    "BEGIN": Begin,
    "COMMIT": Commit,
    "FENCE": Fence,
    "HOST": Host,
}
_NAMES = {kind: name for name, kind in KINDS.items()}
_LARGEST = 1 << 63
_WIDE = frozenset({"world", "rows", "digest"})


class LogChain:
    """The position in a log, which writes or reads the next line.

    Attributes:
        sequence: the number of the next line.
        last: the checksum of the previous line; empty before the first line.
    """

    def __init__(self) -> None:
        self.sequence, self.last = 0, ""

    def write(self, record: Record) -> str:
        body = _json(_content(record, self.sequence))
        self._advance(_checksum(self.last, body))
        return f'{body[:-1]},"checksum":"{self.last}"}}\n'

    def to_dict(self, record: Record) -> dict[str, Any]:
        line = sealed(_content(record, self.sequence), self.last)
        self._advance(line["checksum"])
        return line

    def read(self, line: str | bytes) -> Record:
        try:
            content = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise JournalError(f"line {self.sequence + 1} of the log: {error}") from error
        if not isinstance(content, dict):
            raise JournalError(f"line {self.sequence + 1} of the log is not a JSON object")
        record = self.from_dict(content)
        text = line if isinstance(line, str) else line.decode("utf-8", "replace")
        if text.removesuffix("\n") != _json(content):  # white space, duplicate keys or escapes
            raise JournalError(f"line {self.sequence} of the log has been changed")
        return record

    def from_dict(self, line: dict[str, Any]) -> Record:
        where = f"line {self.sequence + 1} of the log"
        if line.get("schema") != SCHEMA:
            raise JournalError(f"{where} has schema {line.get('schema')!r}, not {SCHEMA!r}")
        if line.get("sequence") != self.sequence:
            raise JournalError(f"{where} has number {line.get('sequence')}, so lines are missing")
        checksum = line.get("checksum")
        if checksum != sealed(line, self.last)["checksum"]:
            raise JournalError(
                f"{where} does not match its checksum: it is damaged or belongs to another log"
            )
        kind = KINDS.get(str(line.get("kind")))
        if kind is None:
            raise JournalError(f"{where} has the unknown kind {line.get('kind')!r}")
        try:
            values = [parse(line[name]) for name, parse in _PARSE[kind]]
        except (KeyError, TypeError, ValueError) as error:
            raise JournalError(f"{where}: {error!r}") from error
        self._advance(str(checksum))
        return kind(*values)

    def _advance(self, checksum: str) -> None:
        self.sequence += 1
        self.last = checksum


def sealed(line: dict[str, Any], last: str = "") -> dict[str, Any]:
    """Return a line with its checksum, after a line with the checksum `last`."""
    content = {key: value for key, value in line.items() if key != "checksum"}
    return content | {"checksum": _checksum(last, _json(content))}


def replay(records: Iterable[Record]) -> Table:
    """Return the table that results from a log, for any number of zones."""
    log = tuple(records)
    if not log or not isinstance(log[0], Reset):
        raise JournalError("a log must begin with a RESET, which has the id of the run")
    table = Table({record.zone for record in log if isinstance(record, Host)})
    for record in log:
        table.apply(record)
    return table


def _content(record: Record, sequence: int) -> dict[str, Any]:
    line: dict[str, Any] = {"schema": SCHEMA, "sequence": sequence, "kind": _NAMES[type(record)]}
    for name, plain in _PLAIN[type(record)]:
        value = getattr(record, name)
        line[name] = value if plain is None else plain(value)
    return line


def _plain(name: str, hint: Any) -> Callable[[Any], Any] | None:
    """Return a function that converts a field's values to JSON values; None: no conversion."""
    if hint is bytes:
        return bytes.hex
    if hint is int and name in _WIDE:
        return "{:x}".format
    if get_origin(hint) is tuple:
        entry = _plain(name, get_args(hint)[0])
        return None if entry is None else lambda entries: [entry(value) for value in entries]
    if hint in (int, bool):
        return None
    parts = [_plain(field, inner) for field, inner in get_type_hints(hint).items()]
    if not any(parts):
        return None
    return lambda entry: [
        value if part is None else part(value) for part, value in zip(parts, entry, strict=True)
    ]


def _parse(name: str, hint: Any) -> Callable[[Any], Any]:
    """Return a function that converts JSON values to a field's values."""
    if hint is bytes:
        return bytes.fromhex
    if hint is int and name in _WIDE:
        return partial(int, base=16)
    if get_origin(hint) is tuple:
        entry = _parse(name, get_args(hint)[0])
        return lambda values: tuple(entry(value) for value in values)
    if hint in (int, bool):
        return partial(_checked, name, hint)
    parts = [_parse(field, inner) for field, inner in get_type_hints(hint).items()]
    return lambda values: hint(*(part(value) for part, value in zip(parts, values, strict=True)))


def _checked(name: str, kind: type[int], value: Any) -> int:
    if type(value) is not kind or abs(value) >= _LARGEST:
        raise TypeError(f"{name} = {value!r}: must be {kind.__name__}, below 2**63")
    return value


def _checksum(last: str, body: str) -> str:
    return blake2b((last + body).encode(), digest_size=8).hexdigest()


_json = json.JSONEncoder(separators=(",", ":")).encode
_HINTS = {
    kind: {field.name: get_type_hints(kind)[field.name] for field in fields(kind)}
    for kind in KINDS.values()
}
_PLAIN = {
    kind: [(name, _plain(name, hint)) for name, hint in hints.items()]
    for kind, hints in _HINTS.items()
}
_PARSE = {
    kind: [(name, _parse(name, hint)) for name, hint in hints.items()]
    for kind, hints in _HINTS.items()
}
