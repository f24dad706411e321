"""`DeadlineWatch` counts the steps that miss their deadline, by the phase in which it passed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cavmarl.core.errors import ConfigError

BEHIND = "behind"  # the step began after its deadline, because earlier steps took too long
WORLD = "world"  # the world advances, sensors included


class DeadlineWatch:
    """A deadline for each step of a world that is paced by the wall clock.

    The deadline is a fixed time after the step is due. Until then, the world has to advance, the
    followers have to get their snapshots and to answer, and their controls have to be queued.

    Args:
        deadline_s: seconds after a step is due.
        now: the wall clock in seconds.

    Attributes:
        steps: number of steps that have ended.
        misses: number of missed deadlines, by the phase that ran when the deadline passed.
        worst_wall_s: largest time by which a step has missed its deadline.

    Raises:
        ConfigError: the deadline is not a finite number above 0.
    """

    def __init__(self, deadline_s: float, now: Callable[[], float]) -> None:
        if not 0.0 < deadline_s < float("inf"):
            raise ConfigError(f"deadline_s = {deadline_s}: must be a number above 0, such as 0.05")
        self.deadline_s = deadline_s
        self.steps = 0
        self.misses: dict[str, int] = {}
        self.worst_wall_s = 0.0
        self._now = now
        self._limit: float | None = None  # deadline of the current step, by the wall clock
        self._phase = WORLD
        self._is_missed = False

    def begin(self, due: float) -> None:
        """Begin a step that was due at a time of the wall clock."""
        self._limit = due + self.deadline_s
        self._phase, self._is_missed = BEHIND, False
        self.note(WORLD)

    def note(self, phase: str) -> None:
        """Note that a phase begins, and that the previous phase has ended."""
        if self._limit is None:
            return
        if not self._is_missed and self._now() > self._limit:
            self._is_missed = True
            self.misses[self._phase] = self.misses.get(self._phase, 0) + 1
        self._phase = phase

    def end(self) -> None:
        """End the current step, if there is one."""
        if self._limit is None:
            return
        self.note("")
        self.steps += 1
        if self._is_missed:
            self.worst_wall_s = max(self.worst_wall_s, self._now() - self._limit)
        self._limit = None

    def report(self) -> dict[str, Any]:
        """Return the deadline, the number of steps, and the misses by phase."""
        return {
            "deadline_s": self.deadline_s,
            "steps": self.steps,
            "missed": sum(self.misses.values()),
            "missed_in": dict(self.misses),
            "worst_wall_s": self.worst_wall_s,
        }
