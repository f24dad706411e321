"""What tests cost: seconds of processor, of their process and of the children it has waited for.

Seconds of processor say the same on a busy machine as on a quiet one; seconds of a clock do not.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import pytest

__all__ = ["CpuTimes"]

ARGUED_S = 2.0  # a test that costs more is marked `slow`, or listed at the end of a run


class CpuTimes:
    """A plugin that adds up what each test costs, over all processes of pytest-xdist."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._last_s = 0.0

    def pytest_runtest_logstart(self) -> None:
        """A test begins."""
        self._last_s = _used_s()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Iterator[Any]:
        """A phase of a test is over: its report carries its cost to the process that adds up."""
        report = yield
        now_s = _used_s()
        report.cpu_s, self._last_s = now_s - self._last_s, now_s
        return report

    def pytest_runtest_logreport(self, report: Any) -> None:
        """The report of a phase has come."""
        self.seconds[report.nodeid] += report.cpu_s

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Say the sum, and the dearest tests."""
        if not self.seconds:
            return
        dear = sorted(((s, name) for name, s in self.seconds.items() if s > ARGUED_S), reverse=True)
        total_s = sum(self.seconds.values())
        terminalreporter.write_line(
            f"{len(self.seconds)} tests cost {total_s:.0f} s of processor;"
            f" {len(dear)} of them more than {ARGUED_S:g} s each"
        )
        for cost_s, name in dear[:10]:
            terminalreporter.write_line(f"  {cost_s:6.1f} s  {name}")


def _used_s() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system
