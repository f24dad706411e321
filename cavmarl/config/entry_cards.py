"""The cards of environments and drivers: README.md of a folder, or the docstring of a script."""

from __future__ import annotations

import ast
import re
from pathlib import Path

CARD_FILE = "README.md"


def sentence_about(path: Path) -> str:
    """Return the first sentence of an entry's README.md, or of a script's docstring.

    If there is none, return the path of the entry.
    """
    try:
        if path.suffix == ".py":
            text = ast.get_docstring(ast.parse(path.read_bytes())) or ""
        else:
            text = (path / CARD_FILE).read_text(encoding="utf-8")
    except (OSError, ValueError, SyntaxError):
        return str(path)
    paragraphs = re.split(r"\n\s*\n", text.strip())
    prose = (part for part in paragraphs if part[:1].isalnum())
    words = " ".join(next(prose, str(path)).split())
    plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", words).replace("`", "")
    return re.split(r"(?<=[.])\s+(?=[A-Z])", plain)[0] if words else str(path)
