"""Changes of one memory arrive in another, whoever else changes what is beside them."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_BACKGROUND
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.parallel.kernels.replica_copies import (
    GROUP,
    mark_agents,
    note_agents,
    note_rows,
    note_spans,
    take_changes,
)

SIZE = 3 * GROUP + 5  # words
BYTES = 8 * SIZE

places = st.lists(st.integers(0, BYTES - 1), max_size=40)


def memory(seed: int = 0) -> NDArray[np.uint64]:
    rng = np.random.default_rng(seed)
    return rng.integers(0, 1 << 62, SIZE, dtype=np.uint64)


def stream() -> NDArray[np.uint64]:
    return np.zeros(2 * SIZE, dtype=np.uint64)


def change(words: NDArray[np.uint64], where: list[int]) -> None:
    for place in where:
        words.view(np.uint8)[place] ^= 1 + place % 255


@given(places, st.integers(0, BYTES), st.integers(0, BYTES))
@settings(max_examples=60, deadline=None)
def test_what_has_changed_arrives_and_nothing_else(where: list[int], a: int, b: int) -> None:
    here, known, there = memory(), memory(), memory()
    change(here, where)
    first, last = min(a, b), max(a, b)
    out = stream()
    at = note_spans(here, known, np.array([[first, last]]), out, 0)
    assert take_changes(out, 0, at, there, known.copy())
    inside = slice(first, last)
    assert (there.view(np.uint8)[inside] == here.view(np.uint8)[inside]).all()
    words = slice(first // 8, -(-last // 8))
    untouched = np.ones(SIZE, dtype=np.bool_)
    untouched[words] = False
    assert (there[untouched] == memory()[untouched]).all()
    assert (known == there).all()
    assert note_spans(here, known, np.array([[first, last]]), out, 0) == 0


@given(places, places)
@settings(max_examples=60, deadline=None)
def test_two_may_change_bytes_of_one_word(first: list[int], second: list[int]) -> None:
    """Each its own ones, and the leader puts them together."""
    second = [place for place in second if place not in first]
    leader, parts = memory(), [memory(), memory()]
    for words, where in zip(parts, (first, second), strict=True):
        change(words, where)
        out, known = stream(), memory()
        at = note_spans(words, known, np.array([[0, BYTES]]), out, 0)
        assert take_changes(out, 0, at, leader, memory())
    expected = memory()
    change(expected, [*first, *second])
    assert (leader == expected).all()


def test_everything_may_have_changed() -> None:
    here, known = memory(1), memory(2)
    out = stream()
    at = note_spans(here, known, np.array([[0, BYTES]]), out, 0)
    assert at == SIZE + 2 * 4
    there = memory(2)
    assert take_changes(out, 0, at, there, memory(2))
    assert (there == here).all()


def test_rows_of_some_zones() -> None:
    """int32 (k, W, C): the last row of one zone shares a word with the first of the next."""
    shape = (3, 2, 5)
    words, known = np.zeros(15, dtype=np.uint64), np.zeros(15, dtype=np.uint64)
    rows: NDArray[np.int32] = words.view(np.int32).reshape(shape)
    rows[...] = np.arange(1, 31).reshape(shape)
    counts = np.array([[5, 1], [2, 0], [3, 5]])
    out, there = np.zeros(99, dtype=np.uint64), np.zeros(15, dtype=np.uint64)
    strides = np.array(rows.strides)
    at = note_rows(words, known, 0, strides, np.array([0, 2]), counts, out, 0)
    assert take_changes(out, 0, at, there, there.copy())
    found = there.view(np.int32).reshape(shape)
    for zone in (0, 2):
        for w in range(2):
            num = counts[zone, w]
            assert (found[zone, w, :num] == rows[zone, w, :num]).all()
    assert (found[1, 0, 1:4] == 0).all()


def test_agents_of_some_zones() -> None:
    rows = np.zeros((2, 1, 4), dtype=VEHICLE)
    rows["driver"] = DRIVER_BACKGROUND
    rows["agent"] = -1
    for zone, i, agent in ((0, 1, 3), (0, 3, 5), (1, 0, 2)):
        rows[zone, 0, i]["driver"], rows[zone, 0, i]["agent"] = DRIVER_AGENT, agent
    marks = np.ones((1, 6), dtype=np.bool_)
    owned = np.array([[3], [1]])
    mark_agents(rows, owned, np.array([0]), marks)
    assert np.flatnonzero(marks).tolist() == [3], "the row behind the owned ones is a ghost"
    mark_agents(rows, owned, np.array([0, 1]), marks)
    assert np.flatnonzero(marks).tolist() == [2, 3]
    words, known = np.zeros(9, dtype=np.uint64), np.zeros(9, dtype=np.uint64)
    terms: NDArray[np.float32] = words.view(np.float32).reshape(1, 6, 3)
    terms[...] = 1.0
    out, there = np.zeros(40, dtype=np.uint64), np.zeros(9, dtype=np.uint64)
    at = note_agents(words, known, 0, terms.strides[1], marks, out, 0)
    assert take_changes(out, 0, at, there, there.copy())
    assert (there.view(np.float32).reshape(1, 6, 3)[0, 2:4] == 1.0).all()
    assert (there.view(np.float32)[:6] == 0.0).all()


def test_what_is_no_change_is_refused() -> None:
    def fits(*words: Any) -> bool:
        given = np.array(words, dtype=np.uint64)
        return bool(take_changes(given, 0, given.size, memory(), memory()))

    assert fits()
    assert fits(0, 0b11, 5, 6)
    assert not fits(0)
    assert not fits(SIZE, 1, 5)
    assert not fits(1 << 63, 1, 5)
    assert not fits(SIZE - 1, 0b10, 5)
    assert not fits(0, 0b111, 5, 6)
