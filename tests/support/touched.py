"""Run the unit tests that a change affects, the closest first (`make quick`).

A test file is affected if it imports a changed module, directly or through other modules. A file is
changed if it differs from the commit at which the branch left `main`, according to git.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections import deque
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 50.0  # no test begins later than this after the first test

# Folders whose Python files are searched for imports, besides the package.
BESIDE = ("tests", "benchmarks", "fuzz", "docs")

# Folders whose files tests read without importing them → these tests.
READ = {
    "envs": ("tests/test_envs_data.py", "tests/test_cards.py", "tests/config/test_registry.py"),
    "agents": ("tests/policies/test_policies.py", "tests/test_cards.py"),
    "configs": ("tests/config/test_registry.py", "tests/train/test_programs.py"),
    "docs": ("tests/test_docs.py",),
    "train": ("tests/train/test_programs.py",),
}
ALWAYS = ("tests/test_tidy.py",)


def changed_files() -> set[str]:
    """Return the paths that have changed since the branch left `main`, including new files."""
    base = _git("merge-base", "HEAD", "main") or ["HEAD"]
    new = _git("ls-files", "--others", "--exclude-standard")
    return {*_git("diff", "--name-only", base[0]), *new}


def touched_tests(changed: Iterable[str]) -> list[str]:
    """Return the test files that the changed files affect, the closest first."""
    files = {
        path.relative_to(ROOT).as_posix()
        for folder in BESIDE
        for path in (ROOT / folder).rglob("*.py")
    }
    importers = _importers(files)
    distances = dict.fromkeys(changed, 0)
    to_visit = deque(distances)
    while to_visit:
        path = to_visit.popleft()
        further = {*importers.get(_module(path), ()), *_readers(path)}
        for other in sorted(further - distances.keys()):
            distances[other] = distances[path] + 1
            to_visit.append(other)
    found = {path: distances[path] for path in files & distances.keys()}
    found |= dict.fromkeys(ALWAYS, 0)
    tests = [path for path in found if path.rpartition("/")[2].startswith("test_")]
    return sorted(tests, key=lambda path: (found[path], path))


def _importers(files: set[str]) -> dict[str, set[str]]:
    """Return the files that import each module directly."""
    graph = grimp.build_graph("cavmarl")
    found: dict[str, set[str]] = {}
    for module in graph.modules:
        found[module] = {_path(other) for other in graph.find_modules_that_directly_import(module)}
    for path in files:
        for module in _imports(path):
            found.setdefault(module, set()).add(path)
    for path in files:
        if path.endswith("/conftest.py"):
            beside = {other for other in files if other.startswith(path[: -len("conftest.py")])}
            found.setdefault(_module(path), set()).update(beside - {path})
    return found


def _imports(path: str) -> set[str]:
    """Return the modules that a file imports; `from a import b` counts as a and as a.b."""
    found = set()
    for node in ast.walk(ast.parse((ROOT / path).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.update({node.module, *(f"{node.module}.{name.name}" for name in node.names)})
    return {name for name in found if name.split(".")[0] in ("cavmarl", *BESIDE)}


def _readers(path: str) -> tuple[str, ...]:
    if path.endswith(".py") and path.startswith("cavmarl/"):
        return ()
    return READ.get(path.split("/")[0], ("tests/test_docs.py",) if path.endswith(".md") else ())


def _module(path: str) -> str:
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


@cache
def _path(module: str) -> str:
    path = ROOT.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return file.relative_to(ROOT).as_posix()


def _git(*words: str) -> list[str]:
    command = ["git", "-c", "core.quotePath=false", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout.split("\n")[:-1]


class RunCount:
    """A plugin that counts the tests that ran and were not skipped."""

    def __init__(self) -> None:
        self.tests = 0

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count a test, unless it was skipped."""
        self.tests += report.when == "call" and not report.skipped


def main() -> int:
    """Run the affected tests, and return the exit code."""
    tests = touched_tests(changed_files())
    print(f"{len(tests)} test files are affected")
    return run(tests, "not slow and not integration and not alone")


def run(tests: list[str], tier: str) -> int:
    """Run the tests of a tier in these files; the exit code is not 0 if no test ran."""
    os.environ["CAVMARL_QUICK_S"] = str(LIMIT_S)
    order = ("-n", "2", "--dist", "loadfile", "--no-loadscope-reorder")
    count = RunCount()
    code = int(pytest.main(["-q", *order, "-m", tier, *tests], plugins=[count]))
    if count.tests == 0:
        print("no test ran: run `make test`", file=sys.stderr)
        return code or 1
    return code


if __name__ == "__main__":
    sys.exit(main())
