"""Jobs that wait for a node, in the order in which they came.

To ask for a node where none is free costs time. So jobs of one kind that cannot be placed are
asked for once, and failed attempts have a rate, over all jobs and waiting requests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from cavmarl.service.event_log import EventLog
from cavmarl.service.node_selection import Chosen, NoNodeError
from cavmarl.service.rate_limit import RateLimit
from cavmarl.service.service_records import SessionRecord

FAILURES_HZ, FAILURES = 100.0, 50.0  # attempts in vain: a second, and at once


class JobQueue:
    """The jobs of a log that no node has.

    Args:
        log: of the service.
        choose: a node for a session, but for some.
        assign: gives a session to a node.
        end: ends a session, as `failed`.
        clock_s: of the attempts.
    """

    def __init__(
        self,
        log: EventLog,
        choose: Callable[[SessionRecord, Sequence[str]], Chosen],
        assign: Callable[[str, Chosen], None],
        end: Callable[[SessionRecord, str], None],
        clock_s: Callable[[], float],
    ) -> None:
        self._log, self._choose, self._assign, self._end = log, choose, assign, end
        self._failures = RateLimit(FAILURES_HZ, FAILURES, clock_s)
        self._next = ""  # the job at which the last pass ended

    def may_try(self) -> bool:
        """Whether another attempt may be in vain."""
        return self._failures.has("")

    def has_failed(self) -> None:
        """An attempt was in vain."""
        if self._failures.has(""):
            self._failures.take("")

    def place(self) -> None:
        """Give jobs to nodes that can take them."""
        waiting = list(self._log.state.waiting)
        if not waiting or not self.may_try():
            return
        first = waiting.index(self._next) if self._next in self._log.state.waiting else 0
        self._next = ""
        hopeless = set()
        for number in waiting[first:] + waiting[:first]:
            session = self._log.state.sessions[number]
            kind = (session.owner_name, *session.needs)  # all else is alike for all
            if kind in hopeless:
                continue
            if not self.may_try():
                self._next = number
                return
            try:
                self._assign(number, self._choose(session, ()))
            except NoNodeError:
                hopeless.add(kind)
                self.has_failed()

    def end_hopeless(self, max_placements: int) -> None:
        """End jobs that no node has taken in time, or that several nodes have not survived."""
        for number in list(self._log.state.waiting):
            session = self._log.state.sessions[number]
            if session.placements >= max_placements:
                self._end(session, f"{session.placements} nodes were lost with it")
                continue
            waited_s = self._log.wall_s() - session.opened_s
            if session.wait_s is None or session.placements or waited_s <= session.wait_s:
                continue
            told = {"of": "job in the queue", "after_s": waited_s}
            self._log.record("session.timeout", number, told, owner=session.owner)
            self._end(session, f"no node took it within {session.wait_s:g} s")
