"""Reads the files of a recording, which may come from an untrusted source.

The metadata of a file are compared with the expected columns and with limits before its rows are
read, so that a small file cannot demand much memory.
"""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Any

from cavmarl.core.errors import RecordingError, require
from cavmarl.recordings.parquet_pages import ParquetSize, parquet_size

# Limits for one table or one column in one part.
MOST_ROWS = 1 << 22  # rows of a table
MOST_RECORDS = 1 << 20  # rows of a table with texts or lists; structures in a column's lists
MOST_VALUES = 1 << 26  # values of a column with lists
MOST_BYTES = 1 << 31  # bytes of the rows of a table
MOST_TEXT_BYTES = 1 << 28  # bytes of the texts of a column
MOST_FILE_BYTES = 1 << 31
MOST_RATIO = 256  # limit of bytes in memory / bytes in the file; LZ4 cannot compress more


def damaged(path: Path, why: str) -> RecordingError:
    """Return the error for a damaged file."""
    return RecordingError(
        f"{path}: is damaged ({' '.join(why.split())}); restore it; or, to read the "
        "earlier parts, remove the files with this number and larger numbers from all folders"
    )


def read_file(path: Path) -> bytes:
    """Read a regular file of limited size; raises OSError if there is no such file."""
    _check_file(path)
    return path.read_bytes()


def read_table(path: Path, schema: Any) -> Any:
    """Read the table in a part's file.

    Args:
        path: the file.
        schema: the Arrow schema of its columns.

    Raises:
        RecordingError: the file is missing or damaged, has other columns or nulls, or is too large.
        MissingExtraError: pyarrow is not installed.
    """
    pa, parquet = require("pyarrow", "record"), require("pyarrow.parquet", "record")
    try:
        content = read_file(path)
        if wrong := _too_large(parquet_size(memoryview(content)), len(content), schema):
            raise damaged(path, wrong)
        with parquet.ParquetFile(
            pa.BufferReader(content),
            page_checksum_verification=True,
            read_dictionary=_text_columns(schema),
        ) as file:
            if wrong := _wrong_columns(file.schema_arrow, schema):
                raise damaged(path, wrong)
            table = file.read()
        for name, column in zip(table.column_names, table.columns, strict=True):
            for chunk in column.chunks:
                if wrong := _wrong_values(chunk):
                    raise damaged(path, f"column {name} {wrong}")
        table = table.cast(schema)
        table.validate(full=True)  # also checks that texts are UTF-8
        return table
    except FileNotFoundError:
        raise RecordingError(
            f"{path}: is missing, although its part was committed; restore it; or, to read the "
            "earlier parts, remove the files with this number and larger numbers from all folders"
        ) from None
    except MemoryError as error:
        raise damaged(path, "its rows need more memory than there is") from error
    except KeyError as error:  # a column of texts is missing
        raise damaged(path, f"it has no column {error.args[0]!r}") from error
    except (OSError, ValueError, TypeError, pa.ArrowException) as error:
        raise damaged(path, str(error)) from error


def _check_file(path: Path) -> None:
    """Raise OSError if a path is not a regular file (for example a device), or is too large."""
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise OSError("it is not a regular file")
    if found.st_size > MOST_FILE_BYTES:
        raise OSError(f"it has {found.st_size} bytes, and {MOST_FILE_BYTES} are allowed")


def _wrong_columns(found: Any, schema: Any) -> str:
    pa = require("pyarrow", "record")
    if found.names != schema.names:
        return f"it has the columns {', '.join(found.names)[:200]}, not {', '.join(schema.names)}"
    for name, kind, expected in zip(schema.names, found.types, schema.types, strict=True):
        plain = kind.value_type if pa.types.is_dictionary(kind) else kind
        if not _is_same(plain, expected):
            return f"column {name} is {str(kind)[:100]}, not {expected}"
    return ""


def _is_same(found: Any, expected: Any) -> bool:
    """Return whether two types are the same except for dictionaries and names of list elements."""
    pa = require("pyarrow", "record")
    if pa.types.is_dictionary(found):
        return _is_same(found.value_type, expected)
    if found.id != expected.id or found.num_fields != expected.num_fields:
        return False
    if pa.types.is_fixed_size_list(expected) and found.list_size != expected.list_size:
        return False
    if not expected.num_fields:
        return bool(found == expected)
    pairs = [(found.field(k), expected.field(k)) for k in range(expected.num_fields)]
    is_named = pa.types.is_struct(expected)
    return all(
        (one.name == other.name or not is_named) and _is_same(one.type, other.type)
        for one, other in pairs
    )


def _too_large(size: ParquetSize, file_bytes: int, schema: Any) -> str:
    rows = size.num_rows
    most = MOST_ROWS if all(map(_plain_bytes, schema.types)) else MOST_RECORDS
    if rows > most:
        return f"it has {rows} rows, and {most} are allowed"
    numbers = rows * sum(map(_plain_bytes, schema.types))
    pages = sum(column.num_bytes for column in size.columns)
    if max(numbers, pages) > min(MOST_BYTES, MOST_RATIO * file_bytes):
        return (
            f"its {rows} rows take {max(numbers, pages)} bytes in memory, which is too much for a "
            f"file of {file_bytes} bytes"
        )
    for column in size.columns:
        if column.num_values != rows and "." not in column.path:
            return f"column {column.path} has {column.num_values} values for {rows} rows"
        if column.num_values > max(MOST_VALUES, numbers) or column.num_words > column.num_values:
            return f"column {column.path} has {column.num_values} values"
    return ""


def _plain_bytes(kind: Any) -> int:
    """Return the size in bytes of a value of a column; 0 for text, and lists of variable length."""
    pa = require("pyarrow", "record")
    if pa.types.is_fixed_size_list(kind):
        return int(kind.list_size) * _plain_bytes(kind.value_type)
    if pa.types.is_string(kind) or kind.num_fields:
        return 0
    return max(1, int(kind.bit_width) // 8)


def _text_columns(schema: Any) -> list[str]:
    """Return the paths of the columns of text, which are read as dictionaries."""
    pa = require("pyarrow", "record")
    found = []

    def search(path: str, kind: Any) -> None:
        if pa.types.is_string(kind):
            found.append(path)
        elif pa.types.is_list(kind):
            search(f"{path}.list.element", kind.value_type)
        elif pa.types.is_struct(kind):
            for k in range(kind.num_fields):
                search(f"{path}.{kind.field(k).name}", kind.field(k).type)

    for name, kind in zip(schema.names, schema.types, strict=True):
        search(name, kind)
    return found


def _wrong_values(array: Any) -> str:
    """Return what is wrong: nulls, too many values, or too much text; empty if nothing."""
    pa, compute = require("pyarrow", "record"), require("pyarrow.compute", "record")
    kind = array.type
    if array.null_count:
        return "has empty fields"
    most = MOST_RECORDS if pa.types.is_struct(kind) else MOST_VALUES
    if len(array) > most and not pa.types.is_fixed_size_list(kind):
        return f"has {len(array)} values, and {most} are allowed"
    if pa.types.is_dictionary(kind):
        lengths = compute.binary_length(array.dictionary).take(array.indices)
        size = compute.sum(lengths.cast(pa.int64())).as_py() or 0
        return f"has {size} bytes of text" if size > MOST_TEXT_BYTES else ""
    if pa.types.is_fixed_size_list(kind):
        return "has empty fields" if array.flatten().null_count else ""
    if pa.types.is_list(kind):
        return _wrong_values(array.flatten())
    if pa.types.is_struct(kind):
        return next(filter(None, map(_wrong_values, array.flatten())), "")
    return ""
