"""Paces steps on the wall clock; simulated time does not depend on it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from cavmarl.core.errors import ConfigError


class Pacer(Protocol):
    """Says when the next step may begin."""

    def wait(self, elapsed_s: float) -> None:
        """Return when the step may begin that starts after `elapsed_s` of simulated time."""
        ...


class Unpaced:
    """A step begins as soon as the one before has ended."""

    def wait(self, elapsed_s: float) -> None:
        """Go on at once."""


@dataclass(frozen=True)
class Lateness:
    """How late steps began, by the wall clock."""

    steps: int  # that have begun
    # of these, that could not begin when they were due, because what went before took too long
    late: int
    mean_wall_s: float  # how long after they were due all of them began, on average
    worst_wall_s: float  # the same, of the worst


class RealTime:
    """Simulated time goes on `factor` times as fast as the wall clock, or slower if it has to.

    A step is due at a fixed time after the first one began, so that lateness is made up for and
    does not add up.

    `factor`: seconds of simulated time a second. `now`: the wall clock in seconds. `sleep`: waits
    so many seconds.

    Raises:
        ConfigError: a factor that is no number above 0.
    """

    def __init__(
        self,
        factor: float = 1.0,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if not 0.0 < factor < float("inf"):
            raise ConfigError(f"pacing by {factor}: must be a number above 0, as 1 or 2.5")
        self._factor = factor
        self._now, self._sleep = now, sleep
        self._origin: float | None = None
        self._steps = self._late = 0
        self._sum_s = self._worst_s = 0.0

    def wait(self, elapsed_s: float) -> None:
        now = self._now()
        if self._origin is None:
            self._origin = now - elapsed_s / self._factor
        early_s = self._origin + elapsed_s / self._factor - now
        if early_s > 0.0:
            self._sleep(early_s)
            early_s = self._origin + elapsed_s / self._factor - self._now()
        elif early_s < 0.0:
            self._late += 1
        late_s = max(0.0, -early_s)
        self._steps += 1
        self._sum_s += late_s
        self._worst_s = max(self._worst_s, late_s)

    @property
    def lateness(self) -> Lateness:
        mean_s = self._sum_s / max(self._steps, 1)
        return Lateness(self._steps, self._late, mean_s, self._worst_s)


class Stepwise:
    """Each step waits for permission.

    Args:
        ask: called with the simulated time in seconds before each step; the step begins when it
            returns.
    """

    def __init__(self, ask: Callable[[float], object]) -> None:
        self._ask = ask

    def wait(self, elapsed_s: float) -> None:
        self._ask(elapsed_s)
