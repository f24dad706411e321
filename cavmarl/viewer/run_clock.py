"""`RunClock`: schedules the steps of a world that pages watch."""

from __future__ import annotations

import time

from cavmarl.viewer.page_requests import PageRequest

IDLE_S = 0.25  # longest time between two checks for requests
LATE_S = 0.5  # a longer delay is not caught up
MOST_STEPS = 10  # largest number of requested steps that wait while paused


class RunClock:
    """The pace and the pause of a world.

    Attributes:
        pace: simulated seconds per second; 0: as fast as possible.
        is_paused: whether steps are only taken one by one, on request.
    """

    def __init__(self, pace: float = 1.0) -> None:
        self.pace = pace
        self.is_paused = False
        self._steps_wanted = 0
        self._due_s = time.monotonic()

    def handle(self, request: PageRequest) -> bool:
        """Apply a request; return whether it was one for the clock."""
        match request.kind:
            case "pause":
                self.is_paused = True
            case "play":
                self.is_paused = False
            case "step":
                self.is_paused = True
                self._steps_wanted = min(self._steps_wanted + 1, MOST_STEPS)
            case "pace" if request.number is not None:
                self.pace = request.number
            case _:
                return False
        self._due_s = time.monotonic()
        return True

    def wait_s(self, now_s: float) -> float:
        """Return the time until the next step is due, at most `IDLE_S`; 0: it is due now."""
        if self._steps_wanted:
            return 0.0
        if self.is_paused:  # a request to play sets the time of the next step
            return IDLE_S
        return min(max(0.0, self._due_s - now_s), IDLE_S) if self.pace else 0.0

    def tick(self, now_s: float, step_s: float) -> None:
        """Record a step of `step_s` simulated seconds."""
        self._steps_wanted = max(0, self._steps_wanted - 1)
        if self.pace:
            self._due_s = max(self._due_s, now_s - LATE_S) + step_s / self.pace
