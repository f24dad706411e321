"""Worlds as bytes, independent of the zones and workers that run them before and after."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from io import BytesIO
from math import prod
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.parallel.memory.shared_memory import Segment
from cavmarl.parallel.state.state_image import Image

Array = NDArray[Any]

# NumPy parses headers as Python literals.
_UNREADABLE = (ValueError, TypeError, SyntaxError, TokenError, OverflowError, RecursionError)


def to_bytes(arrays: Sequence[Array]) -> bytes:
    """Return arrays with their types and shapes as bytes."""
    pieces: list[bytes | memoryview] = []
    for array in arrays:
        there = np.ascontiguousarray(array)
        pieces += (_head(there.dtype, there.shape), there.reshape(-1).view(np.uint8).data)
    return b"".join(pieces)


@lru_cache(maxsize=1024)
def _head(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """Return the header of an array in a NumPy file. Making a header is slow, so it is cached."""
    file, format_of = BytesIO(), np.lib.format
    descr = format_of.dtype_to_descr(dtype)
    format_of.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": shape})
    return file.getvalue()


def from_bytes(content: bytes | bytearray | memoryview, like: Sequence[Array]) -> list[Array]:
    """Return the arrays passed to `to_bytes`, with the types and numbers of axes of `like`.

    Raises:
        ConfigError: the bytes hold different arrays.
    """
    file, found = BytesIO(content), []
    try:
        for other in like:
            array = _read(file, len(content))
            if array.dtype != other.dtype or array.ndim != other.ndim:
                raise ValueError(f"{array.dtype} for {other.dtype}")
            found.append(array.astype(other.dtype, copy=False))
        if file.read(1):
            raise ValueError("there are more arrays")
    except _UNREADABLE as error:
        raise ConfigError(
            "the state belongs to other worlds, or to a version of cavmarl with other arrays "
            f"({error}): use the environment and the version that saved the state"
        ) from error
    return found


def _read(file: BytesIO, end: int) -> Array:
    """Read the next array. Its header may claim any shape, so it is compared with the bytes left.

    Raises one of `_UNREADABLE`.
    """
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError("an array has an unsupported header")
    size = file.read(2)
    shape, is_fortran, dtype = _parsed(size + file.read(int.from_bytes(size, "little")))
    count = prod(shape)
    if is_fortran or dtype.hasobject or count < 0 or count * dtype.itemsize > end - file.tell():
        raise ValueError(f"an array of {dtype} with the shape {shape}")
    array = np.empty(shape, dtype)
    file.readinto(array.reshape(-1).view(np.uint8).data)
    if dtype == np.bool_ and (array.view(np.uint8) > 1).any():
        raise ValueError("a flag is neither true nor false")
    return array


@lru_cache(maxsize=1024)
def _parsed(header: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return the shape, the order and the type in a header. Parsing is slow, so it is cached."""
    return np.lib.format.read_array_header_1_0(BytesIO(header))


class SavedWorlds:
    """Worlds as bytes, in memory that processes share."""

    def __init__(self, segment: Segment) -> None:
        self._image = Image(segment)

    def write(self, saved: Sequence[bytes]) -> None:
        sizes = np.array([len(one) for one in saved], dtype=np.int64)
        self._image.write([sizes, np.frombuffer(b"".join(saved), dtype=np.uint8)])

    def read(self) -> list[bytes]:
        """Return the worlds of the last `write`. Raises WorkerError: the memory is damaged."""
        dtypes: list[np.dtype[Any]] = [np.dtype(np.int64), np.dtype(np.uint8)]
        sizes, content = self._image.read(dtypes)
        return [one.tobytes() for one in np.split(content, np.cumsum(sizes)[:-1])]
