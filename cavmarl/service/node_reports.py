"""What is odd about what nodes tell: clocks that are off, loads that cannot be."""

from __future__ import annotations

from cavmarl.service.event_log import EventLog


class NodeReports:
    """Tells of each oddity once, and of a clock when it is right again.

    Args:
        log: of the service.
        now_s: by the clock that beats are counted by.
        max_skew_s: between two clocks.
    """

    def __init__(self, log: EventLog, now_s: float, max_skew_s: float) -> None:
        self._log, self._max_skew_s = log, max_skew_s
        self._skewed: set[str] = set()
        self._odd: set[str] = set()
        self._ahead_s = log.wall_s() - now_s  # the wall clock, of the other

    def watch_own_clock(self, now_s: float) -> None:
        """Tell of a wall clock that was set: tokens and leases go by it."""
        ahead_s = self._log.wall_s() - now_s
        if abs(jump_s := ahead_s - self._ahead_s) > self._max_skew_s:
            self._ahead_s = ahead_s
            self._log.record("clock.anomaly", "service", {"jump_s": round(jump_s, 3)})

    def accept(self, name: str, sent_s: float) -> None:
        """A beat is as it should be, but perhaps for its time."""
        self._odd.discard(name)
        skew_s = sent_s - self._log.wall_s()
        is_off = abs(skew_s) > self._max_skew_s
        if is_off != (name in self._skewed):
            self._skewed ^= {name}
            kind = "clock.anomaly" if is_off else "clock.right"
            self._log.record(kind, name, {"skew_s": round(skew_s, 3)})

    def refuse(self, name: str, detail: str) -> None:
        """A beat that says what cannot be is refused."""
        if name not in self._odd:
            self._odd.add(name)
            self._log.record("node.misreported", name, {"detail": detail})

    def forget(self, name: str) -> None:
        """The node is known no more."""
        self._odd.discard(name)
        self._skewed.discard(name)
