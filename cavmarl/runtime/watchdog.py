"""Whether a process does the work that it should: one that hangs, or one that is slow."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

__all__ = ["CHECK_S", "Watchdog", "processor_s"]

CHECK_S = 0.1
STILL_CHECKS = 8  # for so long a process may sleep without the processor
STOPPED_CHECKS = 2  # for so long it may be stopped


class Watchdog:
    """Looks at one process again and again while something is expected of it.

    A process that has work to do uses the processor, or waits for it or for a disk, or for a
    process that it has started itself and that does so. If it is stopped, or sleeps, it does not go
    on by itself.

    Args:
        pid: of the process.
        timeout_s: for so long it may work; times in which nobody looked do not count.
    """

    def __init__(self, pid: int, timeout_s: float) -> None:
        self._pid = pid
        self._timeout_s = timeout_s
        self._spent = -1
        self._checks = 0
        self._still = 0
        self._stopped = 0

    def verdict(self) -> str | None:
        """What is wrong with it, in words; to be asked every `CHECK_S`."""
        try:
            state, spent = _look(self._pid)
        except OSError:
            return None  # it has ended, which others notice
        self._checks += 1
        self._stopped = self._stopped + 1 if state in "Tt" else 0
        self._still = self._still + 1 if state == "S" and spent == self._spent else 0
        self._spent = spent
        if self._stopped >= STOPPED_CHECKS:
            return "stopped (SIGSTOP)"
        if self._still >= STILL_CHECKS:
            return f"asleep for {self._still * CHECK_S:.1f} s"
        if self._checks * CHECK_S > self._timeout_s:
            return f"not done after workers.timeout_s = {self._timeout_s:g}"
        return None


def processor_s(pid: int) -> float:
    """Processor time that a process has taken, s."""
    return int(Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii").split()[0]) / 1e9


def _look(pid: int) -> tuple[str, int]:
    """State of a process, a letter, and its processor time in ticks of the system.

    Of one that sleeps, together with those that it has started.
    """
    text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    fields = text.rpartition(")")[2].split()
    state, spent = fields[0], int(fields[11]) + int(fields[12])
    if state != "S":
        return state, spent
    for child in _children(pid):
        with suppress(OSError):  # it has ended
            its_state, its_spent = _look(child)
            state = its_state if its_state in "RD" else state
            spent += its_spent
    return state, spent


def _children(pid: int) -> list[int]:
    path = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(word) for word in path.read_text(encoding="ascii").split()] if path.exists() else []
