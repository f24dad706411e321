"""The queue of jobs that wait for a node, in the order of their arrival.

Searching for a node takes time. Jobs of the same kind therefore share one search, and failed
searches of all jobs and waiting requests have a rate limit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from cavmarl.service.event_log import EventLog
from cavmarl.service.node_selection import Chosen, NoNodeError
from cavmarl.service.rate_limit import RateLimit
from cavmarl.service.service_records import SessionRecord

FAILURES_HZ, FAILURES = 100.0, 50.0  # failed searches: per second, and burst


class JobQueue:
    """The jobs that are not assigned to a node.

    Args:
        log: the event log of the service.
        choose: returns a node for a session; arguments: the session, names of excluded nodes.
        assign: assigns a session to a node.
        end: ends a session as `failed`.
        clock_s: the clock for the rate limit.
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
        self._next = ""  # the job at which the last pass stopped
        self._reasons: dict[tuple[str, ...], str] = {}  # kind → why the last search failed

    def may_try(self) -> bool:
        """Return whether another search may fail without exceeding the rate limit."""
        return self._failures.has("")

    def has_failed(self) -> None:
        """Count a failed search."""
        if self._failures.has(""):
            self._failures.take("")

    def note(self, session: SessionRecord, error: NoNodeError) -> None:
        """Keep the reason why jobs like this one wait."""
        self._reasons[_kind_of(session)] = str(error)

    def reason_of(self, session: SessionRecord) -> str:
        """Return why a queued job waits; empty: no search has failed yet, or not waiting."""
        if session.id not in self._log.state.waiting:
            return ""
        return self._reasons.get(_kind_of(session), "")

    def place(self) -> None:
        """Assign jobs to nodes that can run them."""
        waiting = list(self._log.state.waiting)
        if not waiting or not self.may_try():
            return
        first = waiting.index(self._next) if self._next in self._log.state.waiting else 0
        self._next = ""
        hopeless = set()
        for number in waiting[first:] + waiting[:first]:
            session = self._log.state.sessions[number]
            kind = _kind_of(session)
            if kind in hopeless:
                continue
            if not self.may_try():
                self._next = number
                return
            try:
                self._assign(number, self._choose(session, ()))
            except NoNodeError as error:
                hopeless.add(kind)
                self.note(session, error)
                self.has_failed()

    def end_hopeless(self, max_losses: int) -> None:
        """End jobs whose waiting time is over, or that have lost several nodes."""
        for number in list(self._log.state.waiting):
            session = self._log.state.sessions[number]
            if session.losses >= max_losses:
                self._end(session, f"{session.losses} nodes were lost while they ran the job")
                continue
            waited_s = self._log.wall_s() - session.opened_s
            if session.wait_s is None or session.placements or waited_s <= session.wait_s:
                continue
            told = {"of": "job in the queue", "after_s": waited_s}
            self._log.record("session.timeout", number, told, owner=session.owner)
            why = self.reason_of(session) or "no node was free"
            self._end(session, f"no node took the job within {session.wait_s:g} s: {why}")


def _kind_of(session: SessionRecord) -> tuple[str, ...]:
    """Return the properties of a job that determine which nodes can run it."""
    return session.owner_name, *session.needs
