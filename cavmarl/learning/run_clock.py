"""`RunClock`: where the time of a run goes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

# Worlds that step; what goes between them and the tensors; what the network decides; the updates.
PHASES = ("simulation", "transfer", "inference", "learning")


class RunClock:
    """Adds up wall time by phase.

    Attributes:
        spent_s: of each phase.
    """

    def __init__(self) -> None:
        self.spent_s = dict.fromkeys(PHASES, 0.0)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """The time of a block goes to this phase; not to be nested."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.spent_s[name] += time.perf_counter() - began

    def take(self) -> dict[str, float]:
        """What has been spent since this was last asked."""
        taken, self.spent_s = self.spent_s, dict.fromkeys(PHASES, 0.0)
        return taken
