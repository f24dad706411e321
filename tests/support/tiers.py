"""Tiers of tests: unit, integration, slow, twin, ray, and tests that must run alone.

A test is `integration` if its file imports or calls code that starts processes or reads SUMO, or if
one of its fixtures makes a map. A test is `slow` if it has this mark or is expensive
(`cpu_time.py`). All other tests are unit tests. A unit test is also `twin` if its file imports
`tests.naive`, which has slow implementations of kernels. A test is `ray` if it starts a Ray
cluster. A test is `alone` if it measures time, memory or cores, or kills processes, so that no
other test may run at the same time.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tests.support.cpu_time import files_due

__all__ = ["ALONE_FILES", "ProcessWatch", "TimeLimit", "is_needed", "mark"]

_OF_PROCESSES = re.compile(
    r"^import (subprocess|multiprocessing|libsumo)\b"
    r"|^from tests\.support\.(sumo_worlds|netgenerate|junction_scenes|toy_job) import"
    r"|^from tests\.support\.(dead_ends|local_actors|map_sources|service) import"
    r"|^from tests\.support\.chromium import"
    r"|importorskip\(\"(libsumo|ray)\""
    r"|\bworkers=(?!0\b)|\bbackend=\"(?!local)|\bnodes=",
    re.MULTILINE,
)
_STARTS = {"subprocess.Popen", "os.fork", "os.posix_spawn", "os.system"}
_MAP_FIXTURES = {"shared_maps", "built_map", "town", "town_file"}
_DEAR_FOLDERS = ("tests/cosim/", "tests/train/")

RAY_FILES = (
    "tests/learning/test_ray_job.py",
    "tests/parallel/test_ray_combinations.py",
    "tests/parallel/test_ray_start.py",
    "tests/parallel/test_ray_worlds.py",
)

_IN_RAY = "test_worlds_run_in_a_ray_actor"  # prefix of the names of tests that start a Ray cluster

# These tests measure time, memory or cores, or need a free core.
ALONE_FILES: tuple[str, ...] = (
    "tests/parallel/test_core_placement.py",
    "tests/parallel/test_pool_resources.py",
    "tests/parallel/test_shared_huge_pages.py",
    "tests/parallel/test_worker_pool.py",
    "tests/test_memory.py",
)

# Kernels in these tests use products of unsigned integers, for which NumPy warns of overflow.
_COMPILED_ONLY = (
    "tests/sensors/test_gnss.py",
    "tests/sensors/test_heard_conflicts.py",
    "tests/sensors/test_measuring.py",
    "tests/sensors/test_rig_schedule.py",
    "tests/v2x/",
)


def mark(item: pytest.Item) -> None:
    """Mark a test with its tier, and with `alone` if it must run alone."""
    path = item.path.relative_to(item.config.rootpath).as_posix()
    of_maps = _MAP_FIXTURES & set(getattr(item, "fixturenames", ()))
    if of_maps or path.startswith(_DEAR_FOLDERS) or _starts_processes(item.path):
        item.add_marker(pytest.mark.integration)
    elif _has_twin(item.path) and not path.startswith(_COMPILED_ONLY):
        item.add_marker(pytest.mark.twin)
    if path in ALONE_FILES:
        item.add_marker(pytest.mark.alone)
    if path in RAY_FILES or item.name.startswith(_IN_RAY):
        item.add_marker(pytest.mark.ray)
    for tier in {"alone", "ray", "twin"} & {found.name for found in item.own_markers}:
        assert is_needed(item.path, item.config.rootpath, tier), f"-m {tier} would not read {path}"


def is_needed(path: Path, root: Path, expression: str, turn: int | None = None) -> bool:
    """Return whether a file may have tests of a tier, so that pytest need not import other files.

    Args:
        path: path of the file.
        root: folder of the repository.
        expression: argument of `-m`, such as `twin and not slow`. Files are excluded only if the
            expression begins with `alone`, `ray` or `twin`, or, in a turn, with `slow`.
        turn: turn of `make rotation`, in which only slow tests run.
    """
    if path.suffix != ".py" or not path.name.startswith("test_"):
        return True
    name = path.relative_to(root).as_posix()
    match expression.split(" and ")[0]:
        case "alone":
            return name in ALONE_FILES
        case "ray":
            return name in RAY_FILES or _IN_RAY in path.read_text(encoding="utf-8")
        case "twin":
            return _has_twin(path) and not name.startswith(_COMPILED_ONLY)
        case "slow" if turn is not None:
            return name in files_due(turn) or "mark.slow" in path.read_text(encoding="utf-8")
    return True


@cache
def _starts_processes(path: Path) -> bool:
    return _OF_PROCESSES.search(path.read_text(encoding="utf-8")) is not None


@cache
def _has_twin(path: Path) -> bool:
    return "\nfrom tests.naive" in path.read_text(encoding="utf-8")


class TimeLimit:
    """A plugin for `make quick`: after a time limit, it skips tests of all files but the first.

    The time starts with the first test of a process, so the collection of tests does not count.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._end_s = 0.0  # end in terms of `time.monotonic`; 0 until the first test begins
        self._first_file = Path()

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Store the path of the first file."""
        if session.items:
            self._first_file = session.items[0].path

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Skip the test if the time is over."""
        now = time.monotonic()
        self._end_s = self._end_s or now + self._limit_s
        if now > self._end_s and item.path != self._first_file:
            pytest.skip("the time of `make quick` is over: run `make test`")


class ProcessWatch:
    """A plugin that reports unit tests that start a process."""

    def __init__(self) -> None:
        self.found: set[str] = set()
        self._started = False
        sys.addaudithook(self._look)

    def pytest_runtest_logstart(self) -> None:
        """Note the start of a test."""
        self._started = False

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item) -> Iterator[Any]:
        """Store in the report of a phase whether the test has started a process."""
        report = yield
        is_unit = not any(item.iter_markers("integration")) and not any(item.iter_markers("slow"))
        report.is_no_unit, self._started = self._started and is_unit, False
        return report

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Collect the names of unit tests that have started a process."""
        if getattr(
            report, "is_no_unit", False
        ):  # reports of crashed processes do not have this attribute
            self.found.add(report.nodeid)

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Print the names of these tests."""
        for name in sorted(self.found):
            terminalreporter.write_line(f"a unit test has started a process: {name}")

    def _look(self, event: str, _: tuple[Any, ...]) -> None:
        if event in _STARTS:
            self._started = True
