"""`cavmarl/balance` imports the standard library and NumPy; two listed files import more."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

FILES = sorted((Path(__file__).resolve().parents[2] / "cavmarl/balance").glob("*.py"))
MORE = {"probe": {"psutil"}, "plan_file": {"cavmarl.config.io", "pydantic"}}
IMPURE = {"datetime", "multiprocessing", "os", "random", "shutil", "socket", "subprocess", "time"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_pure_modules_import_only_allowed_modules(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        else:
            continue
        for name in names:
            if any(name.startswith(more) for more in MORE.get(path.stem, ())):
                continue
            ours = name == "cavmarl.core.errors" or name.startswith("cavmarl.balance.")
            top = name.split(".")[0]
            assert ours or top == "numpy" or top in sys.stdlib_module_names, name
            assert path.stem == "probe" or top not in IMPURE, name


def test_these_tests_find_the_files_of_the_package() -> None:
    assert len(FILES) > 10
