"""Arrays that are read from a state image equal the written arrays, whatever it held before.

An image is a copy of arrays in shared memory, with a checksum; it has no pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.errors import WorkerError
from cavmarl.parallel.memory.shared_memory import Segment
from cavmarl.parallel.state.state_image import Image

RECORD = np.dtype(
    [("a", np.float64), ("b", np.int32)]
)  # 12 bytes, which is not a whole number of words


def arrays(lengths: list[int], seed: int) -> list[NDArray[Any]]:
    """Return arrays of these lengths with three dtypes in turn: records, booleans and floats."""
    rng = np.random.default_rng(seed)
    found: list[NDArray[Any]] = []
    for n, length in enumerate(lengths):
        if n % 3 == 0:
            records = np.zeros(length, dtype=RECORD)
            records["a"], records["b"] = rng.random(length), rng.integers(0, 99, length)
            found.append(records)
        elif n % 3 == 1:
            found.append(rng.random((2, length)) < 0.5)
        else:
            found.append(rng.random((length, 3))[:, 1:])
    return found


@settings(deadline=None)
@given(
    st.integers(1, 6).flatmap(
        lambda count: st.lists(
            st.lists(st.integers(0, 40), min_size=count, max_size=count), min_size=1, max_size=5
        )
    )
)
def test_read_arrays_equal_written_arrays(rounds: list[list[int]]) -> None:
    segment = Segment.make(64)
    image, successor = Image(segment), Image(segment)
    for seed, lengths in enumerate(rounds):
        written = arrays(lengths, seed)
        image.write(written)
        read = list(successor.read([array.dtype for array in written]))
        assert [array.shape for array in read] == [array.shape for array in written]
        assert all((a == b).all() for a, b in zip(read, written, strict=True))
    segment.close()


def test_arrays_with_changed_values_are_read_as_written() -> None:
    segment = Segment.make(64)
    image, successor = Image(segment), Image(segment)
    written = arrays([3, 4, 5], 0)
    for _ in range(3):
        image.write(written)
        read = list(successor.read([array.dtype for array in written]))
        assert all((a == b).all() for a, b in zip(read, written, strict=True))
        written[0]["b"] += 1
        written[1][...] = ~written[1]
    segment.close()


def test_another_number_of_arrays_is_read_as_written() -> None:
    segment = Segment.make(64)
    image = Image(segment)
    for lengths in ([3, 4, 5], [3, 4], [3, 4, 5, 6]):
        written = arrays(lengths, 0)
        image.write(written)
        read = list(image.read([array.dtype for array in written]))
        assert all((a == b).all() for a, b in zip(read, written, strict=True))
    segment.close()


def test_an_array_of_more_dimensions_is_read_as_written() -> None:
    segment = Segment.make(64)
    image = Image(segment)
    first = np.arange(5)
    for last in (np.arange(4.0), np.arange(8.0).reshape(2, 2, 2)):
        image.write([first, last])
        read = list(image.read([first.dtype, last.dtype]))
        assert (read[0] == first).all()
        assert (read[1] == last).all()
    segment.close()


def test_a_damaged_image_is_an_error() -> None:
    segment = Segment.make(64)
    image = Image(segment)
    image.write(arrays([30], 0))
    np.frombuffer(segment.map(), dtype=np.int64)[20] += 1
    with pytest.raises(WorkerError, match="is damaged"):
        list(image.read([RECORD]))
    segment.close()
