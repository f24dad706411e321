"""The folder for what cavmarl keeps between runs: compiled kernels, converted maps."""

from __future__ import annotations

import os
import sys
from pathlib import Path

_TOLD: set[Path] = set()


def cache_dir() -> Path:
    """`CAVMARL_CACHE_DIR`; else `cavmarl` in `XDG_CACHE_HOME`; else `~/.cache/cavmarl`."""
    if home := os.environ.get("CAVMARL_CACHE_DIR"):
        return Path(home)
    shared = os.environ.get("XDG_CACHE_HOME", "")
    # A relative one is to be ignored (XDG Base Directory Specification).
    return (Path(shared) if os.path.isabs(shared) else Path.home() / ".cache") / "cavmarl"


def tell_unwritable(error: OSError) -> None:
    """Say on standard error, once, that nothing is kept for the next process."""
    folder = cache_dir()
    if folder not in _TOLD:
        _TOLD.add(folder)
        print(
            f"cavmarl: {folder} cannot be written ({error.strerror or error}): kernels and maps "
            "are made anew in every process; set CAVMARL_CACHE_DIR to a folder with room",
            file=sys.stderr,
            flush=True,
        )
