"""Log records as JSON lines, and back.

A line is an object with the keys `schema` ("cavmarl.ownership/1"), `sequence` (0, 1, 2, …),
`kind` (RESET, BEGIN, COMMIT, FENCE, HOST), `episode`, `tick`, the fields of that kind, and
`checksum`: BLAKE2b of 8 bytes, in hex, over the line as it would be without that key. Bytes are
written in hex, digests of rows and sets too. A list of entries is a list of lists.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import fields
from hashlib import blake2b
from typing import Any, get_args, get_origin, get_type_hints

from cavmarl.errors import CorruptJournalError, JournalError, TornJournalError
from cavmarl.ownership.messages import Begin, Commit, Fence, Host, Record, Reset
from cavmarl.ownership.table import Table

SCHEMA = "cavmarl.ownership/1"
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


def record_to_dict(record: Record, sequence: int) -> dict[str, Any]:
    """A record as plain values, with its checksum."""
    line: dict[str, Any] = {"schema": SCHEMA, "sequence": sequence, "kind": _NAMES[type(record)]}
    for field in fields(record):
        line[field.name] = _plain(field.name, getattr(record, field.name))
    return sealed(line)


def sealed(line: dict[str, Any]) -> dict[str, Any]:
    """A line with the checksum of what stands in it."""
    content = {key: value for key, value in line.items() if key != "checksum"}
    return content | {"checksum": _checksum(content)}


def record_from_dict(line: dict[str, Any], sequence: int) -> Record:
    """The record of a line.

    Raises:
        CorruptJournalError: another schema or sequence number, a wrong checksum or content.
    """
    where = f"line {sequence + 1} of the log"
    if line.get("schema") != SCHEMA:
        raise CorruptJournalError(f"{where} has schema {line.get('schema')!r}, not {SCHEMA!r}")
    if line.get("checksum") != sealed(line)["checksum"]:
        raise CorruptJournalError(f"{where} does not match its checksum")
    if line.get("sequence") != sequence:
        raise CorruptJournalError(f"{where} has number {line.get('sequence')}: lines are missing")
    kind = KINDS.get(str(line.get("kind")))
    if kind is None:
        raise CorruptJournalError(f"{where} is of kind {line.get('kind')!r}, which is none")
    hints = get_type_hints(kind)
    try:
        values = {
            field.name: _value(field.name, hints[field.name], line[field.name])
            for field in fields(kind)
        }
    except (KeyError, TypeError, ValueError) as error:
        raise CorruptJournalError(f"{where}: {error!r}") from error
    return kind(**values)


def record_to_line(record: Record, sequence: int) -> str:
    """A line of the log, with its end."""
    return _json(record_to_dict(record, sequence)) + "\n"


def records_from_lines(text: str) -> tuple[Record, ...]:
    """The records of a whole log.

    Raises:
        TornJournalError: the last line is cut short. `whole_lines` gives the text before it.
        CorruptJournalError: a line is damaged, missing or out of order.
    """
    records = []
    for sequence, line in enumerate(text.splitlines(keepends=True)):
        if not line.endswith("\n"):
            raise TornJournalError(f"line {sequence + 1} of the log is cut short: {line[:40]!r}")
        try:
            content = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise CorruptJournalError(f"line {sequence + 1} of the log: {error}") from error
        if not isinstance(content, dict):
            raise CorruptJournalError(f"line {sequence + 1} of the log is no JSON object")
        records.append(record_from_dict(content, sequence))
    return tuple(records)


def whole_lines(text: str) -> str:
    """A log without what follows its last whole line: a torn record was never acted upon."""
    return text[: text.rfind("\n") + 1]


def replay(records: Iterable[Record]) -> Table:
    """The table that a log leads to, for any number of zones.

    Raises:
        JournalError: the records cannot have been written in this order.
    """
    log = tuple(records)
    if not log or not isinstance(log[0], Reset):
        raise JournalError("a log begins with a RESET, which names the run")
    table = Table({record.zone for record in log if isinstance(record, Host)})
    for record in log:
        table.apply(record)
    return table


def _plain(name: str, value: Any) -> Any:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, tuple):
        names = getattr(value, "_fields", [name] * len(value))
        return [_plain(inner, entry) for inner, entry in zip(names, value, strict=True)]
    return f"{value:x}" if name in _WIDE else value


def _value(name: str, hint: Any, value: Any) -> Any:
    if hint is bytes:
        return bytes.fromhex(value)
    if get_origin(hint) is tuple:
        return tuple(_value(name, get_args(hint)[0], entry) for entry in value)
    if hint is int and name in _WIDE:
        return int(value, 16)
    if hint in (int, bool):
        if type(value) is not hint or abs(value) >= _LARGEST:
            raise TypeError(f"{name} is {value!r}")
        return value
    inner = get_type_hints(hint)
    return hint(
        *(_value(field, inner[field], entry) for field, entry in zip(inner, value, strict=True))
    )


def _json(line: dict[str, Any]) -> str:
    return json.dumps(line, separators=(",", ":"))


def _checksum(line: dict[str, Any]) -> str:
    return blake2b(_json(line).encode(), digest_size=8).hexdigest()
