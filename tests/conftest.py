"""Options and hooks of the test run, and fixtures of all tests."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings

from tests.support.cpu_time import (
    TURNS,
    CpuTimes,
    argued,
    costs_of_files,
    is_due,
    known_costs,
    long_tests,
    rare_tests,
)
from tests.support.tiers import ProcessWatch, TimeLimit, is_needed, mark

if TYPE_CHECKING:
    from cavmarl import CavVectorEnv
    from tests.support.vec_runs import Make


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option `--turn` of `make rotation`."""
    told = f"run only the slow tests of this turn; each slow test runs once in {TURNS} turns"
    parser.addoption("--turn", type=int, help=told)


def pytest_report_header(config: pytest.Config) -> str | None:
    """Return the line of the header that says which part of the slow tests runs."""
    turn = config.option.turn
    return None if turn is None else f"slow tests: part {turn % TURNS + 1} of {TURNS}"


def pytest_configure(config: pytest.Config) -> None:
    """Register the plugins that measure tests, and the profiles of hypothesis."""
    config.pluginmanager.register(CpuTimes(), "cpu_times")
    config.pluginmanager.register(ProcessWatch(), "process_watch")
    if limit_s := os.environ.get("CAVMARL_QUICK_S"):
        config.pluginmanager.register(TimeLimit(float(limit_s)), "time_limit")
    # A busy machine misses deadlines. Without the compiler, few examples are enough.
    settings.register_profile("compiled", deadline=None)
    settings.register_profile("python", deadline=None, max_examples=25)
    settings.load_profile("python" if os.environ.get("NUMBA_DISABLE_JIT") == "1" else "compiled")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Switch the garbage collector off during the collection, because it would take long."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_collection_finish() -> None:
    """Make the garbage collector ignore all objects that exist after the collection."""
    gc.collect()
    gc.freeze()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Skip files without tests of the selected tier (option `-m`)."""
    options = config.option
    is_read = is_needed(collection_path, config.rootpath, options.markexpr, options.turn)
    return None if is_read else True


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark each test with its tier, and sort files by cost, so that long files start early."""
    rare = rare_tests((item.nodeid for item in items), known_costs(), argued())
    for item in items:
        mark(item)
        if item.nodeid in rare:
            item.add_marker(pytest.mark.slow)
    if config.option.turn is not None:
        slow = {item.nodeid for item in items if any(item.iter_markers("slow"))}
        due = {name for name in slow if is_due(name, config.option.turn, long_tests())}
        config.hook.pytest_deselected(items=[item for item in items if item.nodeid in slow - due])
        items[:] = [item for item in items if item.nodeid not in slow - due]
    if hasattr(config, "workerinput") and not config.pluginmanager.has_plugin("time_limit"):
        often = (item.nodeid for item in items if not any(item.iter_markers("slow")))
        costs = costs_of_files(often, known_costs())
        items.sort(key=lambda item: -costs[item.nodeid.partition("::")[0]])


def _let_start(patch: pytest.MonkeyPatch, start: Callable[..., object], context: object) -> None:
    from cavmarl.evaluate import subprocess_calls
    from cavmarl.evaluate.traffic import sumo_side
    from cavmarl.parallel.nodes import node_starters
    from cavmarl.parallel.processes import fork_server
    from cavmarl.traffic.sumo import sumo_process

    for module in (fork_server, node_starters, subprocess_calls, sumo_process):
        patch.setattr(module, "start_python", start)
    patch.setattr(sumo_side, "get_context", lambda how: context)


@pytest.fixture(scope="session", autouse=True)
def forked_processes() -> Iterator[None]:
    """Replace new processes by forks of a process that has loaded the kernels."""
    from tests.support.forked_processes import FORKS, start_forked

    with pytest.MonkeyPatch.context() as patch:
        _let_start(patch, start_forked, FORKS)
        yield


@pytest.fixture
def fresh_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start new interpreters instead of forks, as cavmarl does outside of tests."""
    from cavmarl.core.processes import start_python

    _let_start(monkeypatch, start_python, get_context("spawn"))


@pytest.fixture
def make() -> Iterator[Make]:
    """Yield `make_vec`; close the made environments after the test."""
    from cavmarl import make_vec

    made: list[CavVectorEnv] = []

    def call(env: str, **arguments: Any) -> CavVectorEnv:
        made.append(make_vec(env, **arguments))
        return made[-1]

    yield call
    for vec in made:
        vec.close()


@pytest.fixture(scope="session")
def shared_maps() -> Path:
    """Return the folder of real maps, which is not part of the repository."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "maps"
    folder = Path(os.environ.get("CAVMARL_SHARED_MAPS", beside))
    if not folder.is_dir():
        pytest.skip(f"no real maps in {folder}: set CAVMARL_SHARED_MAPS to their folder")
    return folder


@pytest.fixture(scope="session")
def built_map(shared_maps: Path) -> Callable[[str], Path]:
    """Return a function that builds a real map, or reads it from a cache: `built_map("x.osm")`."""
    from tests.support.kept_maps import built

    return lambda name: built(shared_maps / name)
