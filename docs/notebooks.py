"""Make the notebooks of `examples/` from the scripts beside them.

    python -m docs.notebooks [NAME ...]

A line `# %%` begins a cell of code, `# %% [markdown]` a cell of text. Each script is run, and its
output is stored in the notebook; the script with a training takes a few minutes.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def scripts() -> list[Path]:
    """Return the scripts that have notebooks."""
    return sorted(EXAMPLES.glob("*.py"))


def cells(script: str) -> list[tuple[str, str]]:
    """Return (kind, text) of each cell; kinds are `code` and `markdown`."""
    found: list[tuple[str, list[str]]] = []
    for line in script.splitlines():
        if line in ("# %%", "# %% [markdown]"):
            found.append(("markdown" if line.endswith("]") else "code", []))
        elif found:
            kind, lines = found[-1]
            lines.append(line.removeprefix("#").removeprefix(" ") if kind == "markdown" else line)
    return [(kind, "\n".join(lines).strip("\n")) for kind, lines in found]


def outputs(script: str) -> list[str]:
    """Run the cells of code in a new folder, and return what each of them prints."""
    names: dict[str, Any] = {"__name__": "__main__"}
    printed = []
    with TemporaryDirectory() as folder, contextlib.chdir(folder):
        for kind, text in cells(script):
            if kind == "code":
                with contextlib.redirect_stdout(io.StringIO()) as output:
                    exec(compile(text, "cell", "exec"), names)
                printed.append(output.getvalue())
    return printed


def notebook(script: str, printed: Sequence[str]) -> str:
    """Return a script as a Jupyter notebook; `printed`: output of each cell of code."""
    made: list[dict[str, Any]] = []
    left = iter(enumerate(printed, start=1))
    for number, (kind, text) in enumerate(cells(script)):
        cell: dict[str, Any] = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}}
        if kind == "code":
            count, output = next(left)
            lines = output.splitlines(keepends=True)
            stream = {"name": "stdout", "output_type": "stream", "text": lines}
            cell |= {"execution_count": count, "outputs": [stream] if lines else []}
        made.append(cell | {"source": text.splitlines(keepends=True)})
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    whole = {"cells": made, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    for path in scripts():
        if path.stem in sys.argv[1:] or not sys.argv[1:]:
            source = path.read_text("utf-8")
            path.with_suffix(".ipynb").write_text(notebook(source, outputs(source)), "utf-8")
