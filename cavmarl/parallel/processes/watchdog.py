"""`Watchdog` tells whether a process works, hangs or takes too long."""

from __future__ import annotations

from pathlib import Path

CHECK_S = 0.1  # time between checks
STILL_CHECKS = 8  # checks in a row at which a process may be asleep and use no processor time
AT_WORK = ("R", "D")  # states of a working process: runnable, waiting for a disk
STOPPED_CHECKS = 2  # checks in a row after which a process counts as stopped


class Watchdog:
    """Checks a process from time to time while it has work to do.

    A process that works uses the processor, or waits for the processor or a disk. A process that is
    stopped or sleeps does not continue by itself, unless its descendants work for it.
    """

    def __init__(
        self,
        pid: int,
        timeout_s: float,  # limit on the work; times without calls of `verdict` do not count
        may_sleep: bool = False,  # whether the process may wait for programs other than descendants
    ) -> None:
        self._pid = pid
        self._may_sleep = may_sleep
        self._timeout_s = timeout_s
        self._spent = -1
        self._checks = 0
        self._still = 0
        self._stopped = 0

    def verdict(self) -> str | None:
        """Return what is wrong with the process; None: nothing. Call this every `CHECK_S`."""
        try:
            state, spent = read_state(self._pid)
        except OSError:
            return None  # the process has ended, which its pool notices
        self._checks += 1
        self._stopped = self._stopped + 1 if state in "Tt" else 0
        is_still = state == "S"
        if is_still:  # descendants may work for the process
            for child, ticks in map(_read_state_if_there, descendants(self._pid)):
                is_still &= child not in AT_WORK
                spent += ticks
        self._still = self._still + 1 if is_still and spent == self._spent else 0
        self._spent = spent
        if self._stopped >= STOPPED_CHECKS:
            return "stopped (SIGSTOP)"
        if self._still >= STILL_CHECKS and not self._may_sleep:
            return f"asleep for {self._still * CHECK_S:.1f} s"
        if self._checks * CHECK_S > self._timeout_s:
            return f"not done after workers.timeout_s = {self._timeout_s:g}"
        return None


def is_stopped(pid: int) -> bool:
    """Return whether a process is stopped (SIGSTOP), if the system can tell."""
    return _read_state_if_there(pid)[0] in "Tt"


def processor_s(pid: int) -> float:
    """Return the processor time of a process in s."""
    return int(Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii").split()[0]) / 1e9


def descendants(pid: int) -> list[int]:
    """Return the descendants of a process."""
    try:
        text = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii")
    except OSError:  # the process has ended, or the system cannot tell
        return []
    children = [int(word) for word in text.split()]
    return children + [one for child in children for one in descendants(child)]


def _read_state_if_there(pid: int) -> tuple[str, int]:
    try:
        return read_state(pid)
    except OSError:
        return "X", 0


def read_state(pid: int) -> tuple[str, int]:
    """Return the state of a process, a letter, and its processor time in system ticks."""
    text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    fields = text.rpartition(")")[2].split()
    return fields[0], int(fields[11]) + int(fields[12])
