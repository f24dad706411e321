"""Measures the processor time of the runtime's calls."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Any

CALIBRATION = 2_000  # empty calls of one trial
TRIALS = 10


class Stopwatch:
    """Adds up the times of named calls without its own time; `clock` returns ns."""

    def __init__(self, clock: Callable[[], int] = time.process_time_ns) -> None:
        self._clock = clock
        self.spent: Counter[str] = Counter()
        self.calls: Counter[str] = Counter()
        self._inside = self._around = 0.0
        trials = [self._time_empty_calls() for _ in range(TRIALS)]
        # take the shortest trial, because other programs can only lengthen a trial
        self._inside = min(inside for inside, _ in trials)
        self._around = min(around for _, around in trials)

    def _time_empty_calls(self) -> tuple[float, float]:
        """Return the measured time of an empty call, and the time including the measurement, ns."""
        empty = self.around(_Nothing())
        began = self._clock()
        for _ in range(CALIBRATION):
            empty.nothing()
        around = (self._clock() - began) / CALIBRATION
        inside = self.spent["nothing"] / CALIBRATION
        self.clear()
        return inside, around

    def clear(self) -> None:
        self.spent.clear()
        self.calls.clear()

    def around(self, part: Any) -> Any:
        """Return a proxy of a part of the runtime that times each call of its methods."""
        return _Timed(self, part, self._clock)

    def forget(self, *names: str) -> None:
        """Delete the times of these names."""
        for name in names:
            del self.spent[name], self.calls[name]

    def phases(self) -> dict[str, float]:
        """Return the time of each name in ns, at least 0."""
        return {
            name: max(0.0, ns - self._inside * self.calls[name]) for name, ns in self.spent.items()
        }

    def own(self) -> float:
        """Return the stopwatch's own time in all calls, ns."""
        return self._around * self.calls.total()


class _Nothing:
    def nothing(self) -> None:
        pass


class _Timed:
    """A proxy of a part of the runtime that times each call of its methods."""

    def __init__(self, watch: Stopwatch, part: Any, clock: Callable[[], int]) -> None:
        self._watch = watch
        self._part = part
        self._clock = clock

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._part, name)
        if not callable(method):  # keep constants, to save lookups
            self.__dict__[name] = method
            return method
        watch, clock = self._watch, self._clock

        def timed(*arguments: Any) -> Any:
            began = clock()
            result = method(*arguments)
            watch.spent[name] += clock() - began
            watch.calls[name] += 1
            return result

        self.__dict__[name] = timed
        return timed
