"""`PhaseTimes`: how the time of an update is divided among phases."""

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
        """Add the time of a block to this phase; do not nest."""
        began = time.perf_counter()
        yield
        self.spent_s[phase] += time.perf_counter() - began

    @contextmanager
    def rest(self, phase: str) -> Iterator[None]:
        """Add the time of a block to this phase, minus the time of phases within it."""
        began, before_s = time.perf_counter(), sum(self.spent_s.values())
        yield
        others_s = sum(self.spent_s.values()) - before_s
        self.spent_s[phase] += time.perf_counter() - began - others_s

    def clear(self) -> None:
        """Reset all times to 0."""
        self.spent_s = dict.fromkeys(self.spent_s, 0.0)
