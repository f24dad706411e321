"""The cache folder, for compiled kernels and converted maps."""

from __future__ import annotations

import os
import sys
from pathlib import Path

_REPORTED: set[Path] = set()


def cache_dir() -> Path:
    """Return `CAVMARL_CACHE_DIR`, else `cavmarl` in `XDG_CACHE_HOME`, else `~/.cache/cavmarl`."""
    if home := os.environ.get("CAVMARL_CACHE_DIR"):
        return Path(home)
    shared = os.environ.get("XDG_CACHE_HOME", "")
    # A relative path must be ignored (XDG Base Directory Specification).
    return (Path(shared) if os.path.isabs(shared) else Path.home() / ".cache") / "cavmarl"


def report_unwritable(error: OSError) -> None:
    """Report once, on standard error, that the cache cannot be written."""
    folder = cache_dir()
    if folder not in _REPORTED:
        _REPORTED.add(folder)
        print(
            f"cavmarl: {folder} cannot be written ({error.strerror or error}), so every process "
            "must compile kernels and read maps again; set CAVMARL_CACHE_DIR to a writable folder",
            file=sys.stderr,
            flush=True,
        )
