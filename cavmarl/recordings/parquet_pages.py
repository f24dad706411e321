"""Sizes that a Parquet file states in its footer and in the heads of its pages.

Arrow allocates as much memory as these sizes say, so they are compared with limits before Arrow
reads the file. Footer and heads use Thrift's compact encoding; only the needed fields have names.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

MAGIC = b"PAR1"
MOST_DEPTH = 30  # limit of nested structures
MOST_ITEMS = 1 << 20  # limit of one list in a footer

_NUM_ROWS, _ROW_GROUPS = 3, 4  # fields of the footer
_COLUMNS, _ROWS_OF_GROUP = 1, 3  # fields of a row group
_OTHER_FILE, _COLUMN = 1, 3  # fields of a column of a row group
_PATH, _NUM_VALUES, _COMPRESSED, _DATA, _DICTIONARY = 3, 5, 7, 9, 11  # fields of its metadata
_KIND, _UNCOMPRESSED_PAGE, _COMPRESSED_PAGE = 1, 2, 3  # fields of the head of a page
_PAGES = {0: (5, True), 2: (7, False), 3: (8, True)}  # page kind → field, and whether it has rows


class ColumnSize(NamedTuple):
    """The size of one column of a file."""

    path: str  # dotted names of the column and of its parts
    num_values: int
    num_words: int  # entries of its dictionary
    num_bytes: int  # size of its pages in memory, before they are decoded


class ParquetSize(NamedTuple):
    """The size of a file."""

    num_rows: int
    columns: list[ColumnSize]


def parquet_size(content: memoryview) -> ParquetSize:
    """Return the stated size of a Parquet file; raises ValueError if its structure is damaged."""
    if len(content) < 12 or content[:4] != MAGIC or content[-4:] != MAGIC:
        raise ValueError("it is no Parquet file")
    end = len(content) - 8
    length = int.from_bytes(content[end : end + 4], "little")
    if length > end - 4:
        raise ValueError("its footer is longer than the file")
    footer, _ = _Compact(content[end - length : end]).structure(0)
    groups = _items(footer, _ROW_GROUPS)
    num_rows = _number(footer, _NUM_ROWS)
    if sum(_number(group, _ROWS_OF_GROUP) for group in groups) != num_rows:
        raise ValueError(f"it has {num_rows} rows, but its row groups state another number of rows")
    columns: dict[int, ColumnSize] = {}
    for group in groups:
        for k, column in enumerate(_items(group, _COLUMNS)):
            one = _column_size(content[: end - length], column)
            known = columns.get(k)
            if known is not None:
                one = ColumnSize(
                    one.path, *(a + b for a, b in zip(one[1:], known[1:], strict=True))
                )
            columns[k] = one
    return ParquetSize(num_rows, list(columns.values()))


def _column_size(content: memoryview, column: Any) -> ColumnSize:
    metadata = column.get(_COLUMN)
    if not isinstance(metadata, dict) or _OTHER_FILE in column:
        raise ValueError("the data of a column are in another file")
    path = ".".join(bytes(word).decode() for word in _items(metadata, _PATH, bytes))
    if metadata.get(_NUM_VALUES) == 0:  # an empty column may have no pages
        return ColumnSize(path, 0, 0, 0)
    start, length = _number(metadata, _DATA), _number(metadata, _COMPRESSED)
    if 0 < metadata.get(_DICTIONARY, 0) < start:
        start = _number(metadata, _DICTIONARY)
    if start + length > len(content):
        raise ValueError(f"column {path} is longer than the file")
    values = words = size = 0
    for number, has_rows, page in _pages(content[start : start + length]):
        values, words = values + number * has_rows, words + number * (not has_rows)
        size += page
    if values != _number(metadata, _NUM_VALUES):
        raise ValueError(f"column {path} states another number of values than its pages")
    return ColumnSize(path, values, words, size)


def _pages(content: memoryview) -> Iterator[tuple[int, bool, int]]:
    """Yield the number of values, whether they belong to rows, and the bytes of each page."""
    at = 0
    while at < len(content):
        head, at = _Compact(content).structure(at)
        field, has_rows = _PAGES.get(head.get(_KIND, -1), (0, False))
        inner = head.get(field)
        if not isinstance(inner, dict):
            raise ValueError("a page is of an unknown kind")
        yield _number(inner, 1), has_rows, _number(head, _UNCOMPRESSED_PAGE)
        at += _number(head, _COMPRESSED_PAGE)
    if at != len(content):
        raise ValueError("a page is longer than its column")


def _number(structure: dict[int, Any], field: int) -> int:
    found = structure.get(field)
    if not isinstance(found, int) or found < 0:
        raise ValueError("a number of its footer or of a page is missing or below 0")
    return found


def _items(structure: dict[int, Any], field: int, kind: type = dict) -> list[Any]:
    found = structure.get(field)
    if not isinstance(found, list) or not all(isinstance(one, kind) for one in found):
        raise ValueError("a list of its footer is missing")
    return found


class _Compact:
    """Reads structures in Thrift's compact encoding; raises ValueError if they are damaged."""

    def __init__(self, content: memoryview) -> None:
        self._content = content

    def structure(self, at: int, depth: int = 0) -> tuple[dict[int, Any], int]:
        """Return the fields of the structure at a place by number, and the place after it."""
        if depth > MOST_DEPTH:
            raise ValueError("its structures are nested too deeply")
        found: dict[int, Any] = {}
        field = 0
        while True:
            head, at = self._byte(at), at + 1
            if head == 0:
                return found, at
            kind, step = head & 15, head >> 4
            if step:
                field += step
            else:
                field, at = self._zigzag(at)
            found[field], at = self._value(kind, at, depth)

    def _value(self, kind: int, at: int, depth: int, in_list: bool = False) -> tuple[Any, int]:
        match kind:
            case 1 | 2:
                return kind == 1, at + in_list
            case 3:
                return self._byte(at), at + 1
            case 4 | 5 | 6:
                return self._zigzag(at)
            case 7:
                return struct.unpack("<d", self._bytes(at, 8))[0], at + 8
            case 8:
                length, at = self._varint(at)
                return self._bytes(at, length), at + length
            case 9 | 10:
                return self._list(at, depth)
            case 12:
                return self.structure(at, depth + 1)
        raise ValueError(f"a field has the unknown type {kind}")

    def _list(self, at: int, depth: int) -> tuple[list[Any], int]:
        head, at = self._byte(at), at + 1
        count = head >> 4
        if count == 15:
            count, at = self._varint(at)
        if count > min(MOST_ITEMS, len(self._content) - at):
            raise ValueError(f"a list has {count} items")
        found = []
        for _ in range(count):
            one, at = self._value(head & 15, at, depth + 1, in_list=True)
            found.append(one)
        return found, at

    def _byte(self, at: int) -> int:
        return self._bytes(at, 1)[0]

    def _bytes(self, at: int, length: int) -> bytes:
        if at + length > len(self._content):
            raise ValueError("it ends too early")
        return bytes(self._content[at : at + length])

    def _varint(self, at: int) -> tuple[int, int]:
        found = shift = 0
        while True:
            byte, at = self._byte(at), at + 1
            found |= (byte & 127) << shift
            if byte < 128:
                return found, at
            shift += 7
            if shift > 63:
                raise ValueError("a number is too long")

    def _zigzag(self, at: int) -> tuple[int, int]:
        found, at = self._varint(at)
        return (found >> 1) ^ -(found & 1), at
