"""`make quick`: the unit tests of what a change touches, those nearest to it first.

A test file is touched where it imports a module that has changed, or one that imports such a
module, and so on. What changed is asked of git: the working tree against where it left `main`.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import grimp

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 50.0  # and the tests that are running then come to their end

# Folders of Python files beside the package, whose imports are read off their text.
BESIDE = ("tests", "benchmarks", "fuzz", "docs")

# Files that are read and not imported, and the tests that read them.
READ = {
    "envs": ("tests/test_envs_data.py", "tests/test_cards.py", "tests/config/test_registry.py"),
    "agents": ("tests/policies/test_policies.py", "tests/test_cards.py"),
    "configs": ("tests/config/test_registry.py", "tests/train/test_programs.py"),
    "docs": ("tests/test_docs.py",),
    "train": ("tests/train/test_programs.py",),
}
ALWAYS = ("tests/test_tidy.py",)


def changed_files() -> set[str]:
    """Paths that differ from where this branch left `main`, those that git does not know too."""
    base = _git("merge-base", "HEAD", "main") or ["HEAD"]
    new = _git("ls-files", "--others", "--exclude-standard")
    return {*_git("diff", "--name-only", base[0]), *new}


def touched_tests(changed: Iterable[str]) -> list[str]:
    """Test files that the changed files bear on, the nearest first."""
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
    """Per module, the files that import it themselves."""
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
    """Modules that a file beside the package imports; of `from a import b`, both a and a.b."""
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


def main() -> int:
    """Run them, two at a time; what there is no time for is skipped, and says so."""
    tests = touched_tests(changed_files())
    print(f"{len(tests)} test files are touched")
    order = ("-n", "2", "--dist", "loadfile", "--no-loadscope-reorder")
    command = [sys.executable, "-m", "pytest", "-q", *order]
    command += ["-m", "not slow and not integration and not alone", *tests]
    until_s = {"CAVMARL_QUICK_UNTIL_S": str(time.time() + LIMIT_S)}
    code = subprocess.run(command, cwd=ROOT, env=os.environ | until_s).returncode
    return 0 if code == 5 else code  # 5: no unit test among them


if __name__ == "__main__":
    sys.exit(main())
