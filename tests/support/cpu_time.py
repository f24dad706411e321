"""What tests cost: seconds of processor, with those of children and forks that have ended.

Seconds of processor say the same on a busy machine as on a quiet one; seconds of a clock do not.
`tests/costs.txt` has those of dear tests, as they were when it was made:

    CAVMARL_TEST_COSTS=tests/costs.txt pytest -n 3 --dist loadfile -m "not alone"
"""

from __future__ import annotations

import os
import zlib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import psutil
import pytest

__all__ = [
    "CpuTimes",
    "argued",
    "costs_of_files",
    "is_due",
    "known_costs",
    "long_tests",
    "rare_tests",
]

LISTED_AT_END_S = 2.0  # a test that costs more is listed at the end of a run
ARGUED_S = 2.0  # one that costs more is slow, but for those of the file of argued tests
LISTED_S = 0.5  # a test that costs less is not in the file of costs
OFTEN_S = 1.5  # of a test's variants, so many seconds are in every run, and one of them at least
TURNS = 30  # runs of `make rotation` in which each slow test comes up that is not long
CHEAP_S = 0.05  # what one costs that is not in the file of costs
COSTS = Path(__file__).resolve().parents[1] / "costs.txt"
ARGUED = COSTS.with_name("argued.txt")
LONG = COSTS.with_name("long.txt")


@cache
def known_costs() -> dict[str, float]:
    """Seconds of processor by test, of those that are in the file."""
    lines = COSTS.read_text(encoding="utf-8").splitlines() if COSTS.exists() else []
    return {name: float(cost_s) for cost_s, name in (line.split(" ", 1) for line in lines)}


@cache
def argued() -> frozenset[str]:
    """Dear tests that are in every run, and with `[*]` those whose variants all are."""
    return _listed(ARGUED)


@cache
def long_tests() -> frozenset[str]:
    """Slow tests that are in `make soak` alone; a file stands for all its slow tests."""
    return _listed(LONG)


def _listed(path: Path) -> frozenset[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return frozenset(line for line in lines if line and not line.startswith("#"))


def rare_tests(
    names: Iterable[str], costs: Mapping[str, float], kept: frozenset[str] = frozenset()
) -> set[str]:
    """Which tests are too dear to be in every run.

    Args:
        names: of all tests, in their order; variants of one test differ behind the bracket.
        costs: seconds of processor by name, of those that are known.
        kept: of dear ones, those that are in every run; `[*]` after a test: all its variants.
    """
    spent: dict[str, float] = {}
    rare = set()
    for name in names:
        test, cost_s = name.split("[", 1)[0], costs.get(name, 0.0)
        another = test in spent and spent[test] + cost_s > OFTEN_S and cost_s > 0.0
        another = another and f"{test}[*]" not in kept
        if name not in kept and (cost_s > ARGUED_S or another):
            rare.add(name)
        else:
            spent[test] = spent.get(test, 0.0) + cost_s
    return rare


def is_due(name: str, turn: int, long: frozenset[str]) -> bool:
    """Return whether `make rotation` runs a slow test in a turn: one of `TURNS` in a row.

    The tests of a file come up in different turns, so that no turn has all of an expensive file.

    Args:
        name: of the test.
        turn: number of the turn.
        long: files and tests, without variants, that no turn runs.
    """
    if {name.partition("::")[0], name.partition("[")[0]} & long:
        return False
    return zlib.crc32(name.encode()) % TURNS == turn % TURNS


def costs_of_files(names: Iterable[str], costs: Mapping[str, float]) -> dict[str, float]:
    """Seconds of processor by file, of tests that are in every run; a cheap test counts, too."""
    found: dict[str, float] = defaultdict(float)
    for name in names:
        found[name.partition("::")[0]] += costs.get(name, CHEAP_S)
    return found


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
        # A process of pytest-xdist that has crashed has not said what its test cost.
        self.seconds[report.nodeid] += getattr(report, "cpu_s", 0.0)

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Say the sum, and the dearest tests."""
        if not self.seconds:
            return
        if path := os.environ.get("CAVMARL_TEST_COSTS"):
            listed = sorted((name, s) for name, s in self.seconds.items() if s >= LISTED_S)
            lines = [f"{cost_s:.1f} {name}\n" for name, cost_s in listed]
            Path(path).write_text("".join(lines), encoding="utf-8")
        dear = sorted(
            ((s, name) for name, s in self.seconds.items() if s > LISTED_AT_END_S), reverse=True
        )
        total_s = sum(self.seconds.values())
        terminalreporter.write_line(
            f"{len(self.seconds)} tests cost {total_s:.0f} s of processor;"
            f" {len(dear)} of them more than {LISTED_AT_END_S:g} s each"
        )
        for cost_s, name in dear[:10]:
            terminalreporter.write_line(f"  {cost_s:6.1f} s  {name}")


def _used_s() -> float:
    return sum(os.times()[:4]) + _forks_s()


def _forks_s() -> float:
    """Of the process whose forks tests start, and of those forks that have ended."""
    server: Any = forkserver._forkserver  # type: ignore[attr-defined]
    if server._forkserver_pid is None:
        return 0.0
    try:
        return sum(psutil.Process(server._forkserver_pid).cpu_times()[:4])
    except psutil.NoSuchProcess:
        return 0.0
