"""Blocks of Markdown, between `<!-- NAME -->` and `<!-- end -->`, that tests generate from code.

With `CAVMARL_REWRITE=1` in the environment, a test writes the blocks; otherwise it compares them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from cavmarl.core.atomic_file import write_whole


def table(header: Sequence[str], rows: Iterable[Sequence[str]], *, is_right: bool = False) -> str:
    """Return a Markdown table; `is_right` aligns all columns but the first to the right."""
    others = "---:" if is_right else "---"
    lines = [header, ["---", *[others] * (len(header) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def check_block(path: Path, name: str, expected: str) -> None:
    """Check that the block `name` of a file is `expected`, or write the block."""
    if os.environ.get("CAVMARL_REWRITE"):
        write_block(path, name, expected)
        return
    assert read_block(path, name) == expected, f"{path}: run again with CAVMARL_REWRITE=1"


def read_block(path: Path, name: str) -> str:
    """Return the content of a block."""
    return _block(path, name)[2].rstrip("\n")


def write_block(path: Path, name: str, content: str) -> None:
    """Replace the content of a block without leaving a partly written file."""
    found = _block(path, name)
    text = found.string[: found.end(1)] + content + "\n" + found.string[found.start(3) :]
    write_whole(path, text.encode())


def _block(path: Path, name: str) -> re.Match[str]:
    text = path.read_text(encoding="utf-8")
    pattern = re.compile(rf"(<!-- {re.escape(name)} -->\n)(.*?)(<!-- end -->)", re.DOTALL)
    found = pattern.search(text)
    assert found, f"{path} has no block <!-- {name} --> … <!-- end -->"
    return found
