from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from cavmarl.core.compiled import kernel
from cavmarl.core.math.buckets import Lists, add, forget, lay_out, make_lists
from tests.naive import buckets as naive


@kernel
def add_one(lists: Lists, k: int) -> None:
    """Call `add`, which only kernels can call."""
    add(lists, k)


@st.composite
def crowds(draw: st.DrawFn) -> tuple[int, list[list[int]]]:
    """Draw the number of lists, and several rounds of items for them."""
    number = draw(st.integers(1, 200))
    keys = st.lists(st.integers(0, number - 1), max_size=30)
    return number, draw(st.lists(keys, min_size=1, max_size=4))


@given(crowds())
def test_lists_equal_twin_after_any_earlier_content(case: tuple[int, list[list[int]]]) -> None:
    number, crowd = case
    lists = make_lists(number)
    for keys in crowd:
        forget(lists)
        for k in keys:
            add_one(lists, k)
        assert lay_out(lists) == len(keys)
        for k, place in enumerate(naive.laid_out(number, keys)):
            start, end = lists.bounds[k].tolist()
            assert start == end, "a list has items before it is filled"
            assert start == place.start or not place
        # Write the items at the returned places, as callers do.
        for k in keys:
            lists.bounds[k, 1] += 1
        assert (lists.bounds[:, 1] - lists.bounds[:, 0]).sum() == len(keys)


def test_cleared_lists_are_empty() -> None:
    lists = make_lists(100)
    for k in (3, 3, 64, 99):
        add_one(lists, k)
    lay_out(lists)
    forget(lists)
    assert not lists.bounds.any()
    assert not lists.used.any()
