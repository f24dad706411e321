"""`cavmarl/ownership` uses only the standard library.

It is pure: it uses no input, output, clocks, threads or randomness.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

FILES = sorted((Path(__file__).resolve().parents[2] / "cavmarl/ownership").glob("*.py"))
IMPURE = {
    "asyncio", "datetime", "io", "logging", "multiprocessing", "os", "pathlib", "pickle", "queue",
    "random", "secrets", "select", "shutil", "signal", "socket", "subprocess", "tempfile",
    "threading", "time", "uuid",
}  # fmt: skip


def imports(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module or "")
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_a_file_of_the_package_is_pure(path: Path) -> None:
    for module in imports(path):
        top = module.split(".")[0]
        ours = module == "cavmarl.core.errors" or module.startswith("cavmarl.ownership.")
        assert ours or (top in sys.stdlib_module_names and top not in IMPURE), module


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_a_file_of_the_package_does_not_call_print_open_or_hash(path: Path) -> None:
    called = {
        node.func.id
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert not called & {"print", "open", "input", "hash", "eval", "exec", "__import__"}


@pytest.mark.parametrize("name", ["trace_check", "trace"])
def test_the_trace_checker_does_not_import_the_code_that_it_checks(name: str) -> None:
    (path,) = (path for path in FILES if path.stem == name)
    judged = {"directory", "endpoint", "table", "planning", "decisions", "readiness", "replicas"}
    assert not {f"cavmarl.ownership.{module}" for module in judged} & imports(path)


def test_these_tests_find_the_files_of_the_package() -> None:
    assert len(FILES) > 15
