"""The notebooks of `examples/`, made of the scripts beside them.

    python -m docs.notebooks

A line `# %%` begins a cell of code, `# %% [markdown]` one of text.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def scripts() -> list[Path]:
    """Of which there are notebooks."""
    return sorted(EXAMPLES.glob("*.py"))


def cells(script: str) -> list[tuple[str, str]]:
    """(kind, text) of each cell, `code` or `markdown`."""
    found: list[tuple[str, list[str]]] = []
    for line in script.splitlines():
        if line in ("# %%", "# %% [markdown]"):
            found.append(("markdown" if line.endswith("]") else "code", []))
        elif found:
            kind, lines = found[-1]
            lines.append(line.removeprefix("#").removeprefix(" ") if kind == "markdown" else line)
    return [(kind, "\n".join(lines).strip("\n")) for kind, lines in found]


def notebook(script: str) -> str:
    """A script as a Jupyter notebook without outputs."""
    made: list[dict[str, Any]] = []
    for number, (kind, text) in enumerate(cells(script)):
        cell: dict[str, Any] = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}}
        if kind == "code":
            cell |= {"execution_count": None, "outputs": []}
        made.append(cell | {"source": text.splitlines(keepends=True)})
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    whole = {"cells": made, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    for path in scripts():
        path.with_suffix(".ipynb").write_text(notebook(path.read_text("utf-8")), "utf-8")
