"""Examples of docs/guides/libraries.md that need other libraries run."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs" / "guides" / "libraries.md"
LIBRARIES = ("supersuit", "tianshou", "skrl", "agilerl", "ray.rllib")


def example(library: str) -> str:
    """Return the only program of the page that imports this library."""
    text = PAGE.read_text(encoding="utf-8")
    programs: list[str] = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    uses = re.compile(rf"^(from|import) {library}\b", re.MULTILINE)
    (found,) = filter(uses.search, programs)
    return found


@pytest.mark.parametrize("library", LIBRARIES)
def test_each_library_has_an_example(library: str) -> None:
    compile(example(library), library, "exec")


@pytest.mark.slow
@pytest.mark.parametrize("library", LIBRARIES)
def test_the_example_of_each_library_runs(library: str, tmp_path: Path) -> None:
    pytest.importorskip(library, reason="no extra of cavmarl: install it to try it")
    if library == "supersuit":
        pytest.importorskip("stable_baselines3", reason="needs the extra: train")
    program = tmp_path / "program.py"
    program.write_text(example(library), encoding="utf-8")
    command = [sys.executable, str(program)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
