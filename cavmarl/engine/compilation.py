"""Compiles kernels before the first step, and says so."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numba.core.config

from cavmarl.core.numba import kernel_cache_dir

__all__ = ["compiled_before", "first_compilation"]


def compiled_before() -> bool:
    """Whether this version's kernels have been compiled on this machine, or never will be."""
    settings: Any = numba.core.config
    return bool(settings.DISABLE_JIT) or (kernel_cache_dir() / "complete").exists()


@contextmanager
def first_compilation() -> Iterator[bool]:
    """Announce a first compilation on standard error; yields whether this is one.

    What runs inside has to call every kernel once: then they are marked as complete.
    """
    if compiled_before():
        yield False
        return
    print(
        "cavmarl: compiling kernels, once for this version (up to a minute) …",
        end="",
        file=sys.stderr,
        flush=True,
    )
    started = time.perf_counter()
    yield True
    kernel_cache_dir().mkdir(parents=True, exist_ok=True)
    (kernel_cache_dir() / "complete").touch()
    print(f" done in {time.perf_counter() - started:.0f} s", file=sys.stderr, flush=True)
