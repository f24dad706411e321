"""Checks of the reports of nodes, for wrong clocks and impossible loads."""

from __future__ import annotations

from cavmarl.service.event_log import EventLog


class NodeReports:
    """Checks the reports of nodes; records each fault once, and when a clock is right again.

    Args:
        log: the event log of the service.
        now_s: the clock for heartbeats.
        max_skew_s: tolerated difference of two clocks.
    """

    def __init__(self, log: EventLog, now_s: float, max_skew_s: float) -> None:
        self._log, self._max_skew_s = log, max_skew_s
        self._skewed: set[str] = set()
        self._odd: set[str] = set()
        self._ahead_s = log.wall_s() - now_s  # wall clock minus the clock for heartbeats

    def watch_own_clock(self, now_s: float) -> None:
        """Record a jump of the service's wall clock, on which tokens and leases depend."""
        ahead_s = self._log.wall_s() - now_s
        if abs(jump_s := ahead_s - self._ahead_s) > self._max_skew_s:
            self._ahead_s = ahead_s
            self._log.record("clock.anomaly", "service", {"jump_s": round(jump_s, 3)})

    def accept(self, name: str, sent_s: float) -> None:
        """Check the time of a valid heartbeat."""
        self._odd.discard(name)
        skew_s = sent_s - self._log.wall_s()
        is_off = abs(skew_s) > self._max_skew_s
        if is_off != (name in self._skewed):
            self._skewed ^= {name}
            kind = "clock.anomaly" if is_off else "clock.right"
            self._log.record(kind, name, {"skew_s": round(skew_s, 3)})

    def refuse(self, name: str, detail: str) -> None:
        """Record a heartbeat with impossible values."""
        if name not in self._odd:
            self._odd.add(name)
            self._log.record("node.misreported", name, {"detail": detail})

    def forget(self, name: str) -> None:
        """Forget a node."""
        self._odd.discard(name)
        self._skewed.discard(name)
