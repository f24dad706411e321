"""`code_stamp`: identifies the code of a process; different code may give different results."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import numpy as np


@cache
def code_stamp() -> str:
    """Return the digest of all sources and the version of NumPy, as text."""
    package = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        name = source.relative_to(package).as_posix()
        if not name.startswith("data/"):  # only wheels have this folder
            digest.update(name.encode() + b"\0" + source.read_bytes())
    sources = digest.hexdigest()[:12]
    return f"cavmarl of sources {sources}, numpy {np.__version__}"
