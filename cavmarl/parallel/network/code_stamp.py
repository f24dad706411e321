"""What a process runs, in words; processes that differ in it give other results."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import numpy as np


@cache
def code_stamp() -> str:
    """What this machine runs: digest of all sources, and the libraries that compute."""
    package = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        name = source.relative_to(package).as_posix()
        if not name.startswith("data/"):  # which only a wheel has
            digest.update(name.encode() + b"\0" + source.read_bytes())
    sources = digest.hexdigest()[:12]
    return f"cavmarl of sources {sources}, numpy {np.__version__}"
