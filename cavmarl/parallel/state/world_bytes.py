"""Worlds as bytes: what goes into a file, whichever zones and workers run them before and after."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.parallel.memory.shared_memory import Segment
from cavmarl.parallel.state.state_image import Image

Array = NDArray[Any]


def to_bytes(arrays: Sequence[Array]) -> bytes:
    """Arrays with their types and shapes."""
    pieces: list[bytes | memoryview] = []
    for array in arrays:
        there = np.ascontiguousarray(array)
        pieces += (_head(there.dtype, there.shape), there.reshape(-1).view(np.uint8).data)
    return b"".join(pieces)


@lru_cache(maxsize=1024)
def _head(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """What stands before an array in a file of NumPy's; to put it together takes long."""
    file, format_of = BytesIO(), np.lib.format
    told = format_of.dtype_to_descr(dtype)
    format_of.write_array_header_1_0(file, {"descr": told, "fortran_order": False, "shape": shape})
    return file.getvalue()


def from_bytes(content: bytes | bytearray | memoryview, like: Sequence[Array]) -> list[Array]:
    """What `to_bytes` was given, of the types and numbers of axes of others.

    Raises:
        ConfigError: it was something else.
    """
    file, found = BytesIO(content), []
    try:
        for other in like:
            array = np.lib.format.read_array(file, allow_pickle=False)
            if array.dtype != other.dtype or array.ndim != other.ndim:
                raise ValueError(f"{array.dtype} for {other.dtype}")
            found.append(array.astype(other.dtype, copy=False))
        if file.read(1):
            raise ValueError("more arrays than there are")
    except ValueError as error:
        raise ConfigError(
            "the state is one of other worlds, or of another version of cavmarl, which keeps "
            f"other arrays ({error}): use the environment and the version that saved it"
        ) from error
    return found


class SavedWorlds:
    """Some worlds as bytes, in memory that processes share."""

    def __init__(self, segment: Segment) -> None:
        self._image = Image(segment)

    def write(self, saved: Sequence[bytes]) -> None:
        sizes = np.array([len(one) for one in saved], dtype=np.int64)
        self._image.write([sizes, np.frombuffer(b"".join(saved), dtype=np.uint8)])

    def read(self) -> list[bytes]:
        """Raises WorkerError: it is not what was put there."""
        dtypes: list[np.dtype[Any]] = [np.dtype(np.int64), np.dtype(np.uint8)]
        sizes, content = self._image.read(dtypes)
        return [one.tobytes() for one in np.split(content, np.cumsum(sizes)[:-1])]
