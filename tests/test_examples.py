"""The notebooks of `examples/` equal the scripts beside them, and their cells run."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from docs.notebooks import notebook, scripts

SCRIPTS = scripts()

each = pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)

# Run all code cells of a notebook in order.
RUN = """\
import json, sys
shared = {"__name__": "__main__"}
for cell in json.load(open(sys.argv[1], encoding="utf-8"))["cells"]:
    if cell["cell_type"] == "code":
        exec(compile("".join(cell["source"]), sys.argv[1], "exec"), shared)
"""


def test_there_are_three_notebooks() -> None:
    assert len(SCRIPTS) == 3


@each
def test_a_notebook_equals_its_script(script: Path) -> None:
    made = script.with_suffix(".ipynb").read_text(encoding="utf-8")
    found = json.loads(made)["cells"]
    code = [cell for cell in found if cell["cell_type"] == "code"]
    printed = [
        "".join(line for output in cell["outputs"] for line in output["text"]) for cell in code
    ]
    source = script.read_text(encoding="utf-8")
    assert made == notebook(source, printed), f"run python -m docs.notebooks {script.stem}"
    assert found[0]["cell_type"] == "markdown"
    assert len(code) >= 2


@each
def test_a_notebook_has_the_output_of_each_cell_that_prints(script: Path) -> None:
    made = json.loads(script.with_suffix(".ipynb").read_text(encoding="utf-8"))
    for cell in made["cells"]:
        if cell["cell_type"] == "code":
            prints = re.search(r"^ *print\(", "".join(cell["source"]), re.MULTILINE)
            assert bool(cell["outputs"]) == bool(prints)


@each
def test_a_notebook_runs(script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if script.stem == "train_and_evaluate":
        pytest.importorskip("torch", reason="needs the extra: train")
    if script.stem == "own_map_and_reward":
        pytest.importorskip("sumo", reason="needs the extra: sumo")
    monkeypatch.setenv("CAVMARL_SHORT", "1")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    made = script.with_suffix(".ipynb")
    ran = subprocess.run(
        [sys.executable, "-c", RUN, str(made)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip()
