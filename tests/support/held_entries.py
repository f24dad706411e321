"""Count the entries in the containers of an object, to check that its memory does not grow."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any


def held_entries(root: Any) -> int:
    """Return the number of entries in the containers of `root` and of its package objects."""
    seen: set[int] = set()
    stack, entries = [root], 0
    while stack:
        value = stack.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, dict):
            entries += len(value)
            stack += [*value, *value.values()]
        elif isinstance(value, list | tuple | set | frozenset | deque):
            entries += len(value)
            stack += value
        elif type(value).__module__.startswith("cavmarl."):
            stack += _attributes(value)
    return entries


def _attributes(value: Any) -> Iterator[Any]:
    yield from vars(value).values() if hasattr(value, "__dict__") else ()
    for kind in type(value).__mro__:
        for name in getattr(kind, "__slots__", ()):
            yield getattr(value, name, None)
