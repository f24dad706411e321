"""Blocks of Markdown that are generated from the code: between `<!-- NAME -->` and `<!-- end -->`.

With `CAVMARL_REWRITE=1` in the environment a test writes them, else it compares.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def check_block(path: Path, name: str, expected: str) -> None:
    """Assert that the block `name` of the file says what is `expected`, or make it so."""
    text = path.read_text(encoding="utf-8")
    pattern = re.compile(rf"(<!-- {re.escape(name)} -->\n)(.*?)(<!-- end -->)", re.DOTALL)
    found = pattern.search(text)
    assert found, f"{path} has no block <!-- {name} --> … <!-- end -->"
    if os.environ.get("CAVMARL_REWRITE"):
        whole = text[: found.end(1)] + expected + "\n" + text[found.start(3) :]
        path.write_text(whole, encoding="utf-8")
        return
    assert found[2].rstrip("\n") == expected, f"{path}: run again with CAVMARL_REWRITE=1"
