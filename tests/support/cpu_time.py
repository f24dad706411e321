"""The processor time of tests, including ended children and forks.

Processor time does not depend on other programs, unlike wall time. `tests/costs.txt` has the
processor times of expensive tests. This command records it:

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
    "files_due",
    "is_due",
    "known_costs",
    "long_tests",
    "rare_tests",
]

LISTED_AT_END_S = 2.0  # tests above this time are listed at the end of a run
ARGUED_S = 1.0  # tests above this time are slow, unless argued.txt lists them
LISTED_S = 0.5  # tests below this time are not in costs.txt
OFTEN_S = 0.5  # time for the variants of a test in every run; the cheapest variant always runs
TURNS = 30  # turns of `make rotation` in which each slow test runs once, except long tests
CHEAP_S = 0.05  # assumed time of a test that is not in costs.txt
COSTS = Path(__file__).resolve().parents[1] / "costs.txt"
ARGUED = COSTS.with_name("argued.txt")
LONG = COSTS.with_name("long.txt")


@cache
def known_costs() -> dict[str, float]:
    """Return the processor times in s by test, as in costs.txt."""
    lines = COSTS.read_text(encoding="utf-8").splitlines() if COSTS.exists() else []
    return {name: float(cost_s) for cost_s, name in (line.split(" ", 1) for line in lines)}


@cache
def argued() -> frozenset[str]:
    """Return the expensive tests of every run; `[*]` stands for all variants of a test."""
    return _listed(ARGUED)


@cache
def long_tests() -> frozenset[str]:
    """Return the slow tests that only `make soak` runs; a file stands for all its slow tests."""
    return _listed(LONG)


def _listed(path: Path) -> frozenset[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return frozenset(line for line in lines if line and not line.startswith("#"))


def rare_tests(
    names: Iterable[str], costs: Mapping[str, float], kept: frozenset[str] = frozenset()
) -> set[str]:
    """Return the tests that are too expensive for every run.

    Args:
        names: names of all tests; the names of variants of a test differ after the bracket.
        costs: known processor times in s by name.
        kept: expensive tests that are in every run; `[*]` stands for all variants of a test.
    """
    spent: dict[str, float] = {}
    rare = set()
    for name in sorted(names, key=lambda name: costs.get(name, 0.0)):
        test, cost_s = name.split("[", 1)[0], costs.get(name, 0.0)
        another = test in spent and spent[test] + cost_s > OFTEN_S and cost_s > 0.0
        another = another and f"{test}[*]" not in kept
        if name not in kept and (cost_s > ARGUED_S or another):
            rare.add(name)
        else:
            spent[test] = spent.get(test, 0.0) + cost_s
    return rare


def is_due(name: str, turn: int, long: frozenset[str]) -> bool:
    """Return whether `make rotation` runs a slow test in a turn.

    Each test is due in one of `TURNS` consecutive turns. The tests of a file are spread over the
    turns, so that no turn runs all tests of an expensive file.

    Args:
        name: name of the test.
        turn: number of the turn.
        long: files and tests, without variants, that no turn runs.
    """
    if {name.partition("::")[0], name.partition("[")[0]} & long:
        return False
    return zlib.crc32(name.encode()) % TURNS == turn % TURNS


@cache
def files_due(turn: int) -> frozenset[str]:
    """Return the files with a test in costs.txt that is due in a turn."""
    due = (name for name in known_costs() if is_due(name, turn, long_tests()))
    return frozenset(name.partition("::")[0] for name in due)


def costs_of_files(names: Iterable[str], costs: Mapping[str, float]) -> dict[str, float]:
    """Return the processor time in s of tests, by file; unknown costs are `CHEAP_S`."""
    found: dict[str, float] = defaultdict(float)
    for name in names:
        found[name.partition("::")[0]] += costs.get(name, CHEAP_S)
    return found


class CpuTimes:
    """A plugin that sums the processor time of each test over all processes of pytest-xdist."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._last_s = 0.0

    def pytest_runtest_logstart(self) -> None:
        """Note the start of a test."""
        self._last_s = _used_s()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Iterator[Any]:
        """Store the processor time of a phase in its report."""
        report = yield
        now_s = _used_s()
        report.cpu_s, self._last_s = now_s - self._last_s, now_s
        return report

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Add the time of a report."""
        # Reports of crashed processes of pytest-xdist have no time.
        self.seconds[report.nodeid] += getattr(report, "cpu_s", 0.0)

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Print the total time and the most expensive tests."""
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
    """Return the processor time of the fork server of the tests and of its ended forks."""
    server: Any = forkserver._forkserver  # type: ignore[attr-defined]
    if server._forkserver_pid is None:
        return 0.0
    try:
        return sum(psutil.Process(server._forkserver_pid).cpu_times()[:4])
    except psutil.NoSuchProcess:
        return 0.0
