"""Rate limits: a number of requests per second after a burst."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable

from cavmarl.service.error_names import problem

MOST_BUCKETS = 10_000  # callers whose counts are kept


class RateLimit:
    """A limit of requests per second for each caller, after a burst."""

    def __init__(
        self, rate_hz: float, burst: float, clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        self.rate_hz, self.burst = rate_hz, burst
        self._clock_s = clock_s
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def has(self, caller: str) -> bool:
        """Return whether `take` would accept another request."""
        return self._left(caller, self._clock_s()) >= 1.0

    def take(self, caller: str) -> None:
        """Count a request of `caller`; raise the problem `too-many` at the limit.

        A refused request does not count, so the next one is accepted after the time in the problem.
        """
        now_s = self._clock_s()
        left = self._left(caller, now_s)
        self._buckets.pop(caller, None)
        self._buckets[caller] = (left - 1.0 if left >= 1.0 else left, now_s)
        while len(self._buckets) > MOST_BUCKETS:
            self._buckets.popitem(last=False)
        if left < 1.0:
            wait_s = (1.0 - left) / self.rate_hz
            raise problem(
                "too-many", f"more than {self.rate_hz:g} requests per second: wait", wait_s
            )

    def _left(self, caller: str, now_s: float) -> float:
        left, then_s = self._buckets.get(caller, (self.burst, now_s))
        return min(self.burst, left + (now_s - then_s) * self.rate_hz)
