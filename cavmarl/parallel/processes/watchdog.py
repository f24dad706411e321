"""`Watchdog` tells whether a process works, hangs or is slow."""

from __future__ import annotations

from pathlib import Path

CHECK_S = 0.1
STILL_CHECKS = 8  # for so long a process may sleep without the processor
AT_WORK = ("R", "D")  # states: runs or could, waits for a disk
STOPPED_CHECKS = 2  # for so long it may be stopped


class Watchdog:
    """Looks at one process again and again while something is expected of it.

    A process that has work to do uses the processor, or waits for it or for a disk. If it is
    stopped, or sleeps, it does not go on by itself, unless processes that it has started do.
    """

    def __init__(
        self,
        pid: int,  # of the process
        timeout_s: float,  # for so long it may work; without_journals times do not count
    ) -> None:
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
        is_still = state == "S"
        if is_still:  # those that it has started may work for it, or wait for the processor
            for child, ticks in map(_look_if_there, _started_by(self._pid)):
                is_still &= child not in AT_WORK
                spent += ticks
        self._still = self._still + 1 if is_still and spent == self._spent else 0
        self._spent = spent
        if self._stopped >= STOPPED_CHECKS:
            return "stopped (SIGSTOP)"
        if self._still >= STILL_CHECKS:
            return f"asleep for {self._still * CHECK_S:.1f} s"
        if self._checks * CHECK_S > self._timeout_s:
            return f"not done after workers.timeout_s = {self._timeout_s:g}"
        return None


def is_stopped(pid: int) -> bool:
    """Whether a process is stopped (SIGSTOP), where the system tells."""
    return _look_if_there(pid)[0] in "Tt"


def processor_s(pid: int) -> float:
    """Processor time that a process has taken, s."""
    return int(Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii").split()[0]) / 1e9


def _started_by(pid: int) -> list[int]:
    """The processes that one has started, and those that they have."""
    try:
        text = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii")
    except OSError:  # it has ended, or the system does not tell
        return []
    children = [int(word) for word in text.split()]
    return children + [one for child in children for one in _started_by(child)]


def _look_if_there(pid: int) -> tuple[str, int]:
    try:
        return _look(pid)
    except OSError:
        return "X", 0


def _look(pid: int) -> tuple[str, int]:
    """State of a process, a letter, and its processor time in ticks of the system."""
    text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    fields = text.rpartition(")")[2].split()
    return fields[0], int(fields[11]) + int(fields[12])
