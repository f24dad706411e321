"""`PhaseTimes`: what the seconds of an update went to."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


class PhaseTimes:
    """Seconds by phase, since `clear`."""

    def __init__(self, phases: Iterable[str]) -> None:
        self.spent_s = dict.fromkeys(phases, 0.0)

    @contextmanager
    def of(self, phase: str) -> Iterator[None]:
        """The time of a block goes to this phase; not to be nested."""
        began = time.perf_counter()
        yield
        self.spent_s[phase] += time.perf_counter() - began

    @contextmanager
    def rest(self, phase: str) -> Iterator[None]:
        """The time of a block goes to this phase, less what others get within it."""
        began, before_s = time.perf_counter(), sum(self.spent_s.values())
        yield
        others_s = sum(self.spent_s.values()) - before_s
        self.spent_s[phase] += time.perf_counter() - began - others_s

    def clear(self) -> None:
        """Begin at 0."""
        self.spent_s = dict.fromkeys(self.spent_s, 0.0)
