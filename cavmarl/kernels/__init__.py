"""Compiled kernels: arrays and scalars in, arrays out. They know no object and no setting.

`kernel` is the one place for compiler flags: no fastmath (results must not depend on how a world is
divided), serial (processes give the parallelism), GIL released, cached on disk. And no runtime that
counts references to arrays: a kernel allocates nothing and returns no array, so there is nothing to
count, and counting took two thirds of a step (docs/decisions/008). One that needs room of its own
is a `setup_kernel`, for work that is done once.

The cache lives in a folder named after the content of all kernel sources: Numba itself only watches
the file that defines a function, not the functions which that one calls, and would hand out stale
code. Set `CAVMARL_CACHE_DIR` to move it (default: `~/.cache/cavmarl`). With `NUMBA_DISABLE_JIT=1`
every kernel is plain Python.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba
import numba.core.config

__all__ = ["cache_dir", "kernel", "kernel_cache_dir", "setup_kernel"]

P = ParamSpec("P")
R = TypeVar("R")


def cache_dir() -> Path:
    """The folder for everything cavmarl keeps between runs (compiled kernels, converted maps)."""
    home = os.environ.get("CAVMARL_CACHE_DIR")
    return Path(home) if home else Path.home() / ".cache" / "cavmarl"


@cache
def kernel_cache_dir() -> Path:
    """The folder of this version's compiled kernels: one per content of the kernel sources."""
    digest = hashlib.sha256(numba.__version__.encode())
    package = Path(__file__).parent
    for source in sorted(package.glob("*.py")):
        digest.update(source.name.encode() + b"\0" + source.read_bytes())
    return cache_dir() / "kernels" / digest.hexdigest()[:16]


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` with the flags that all kernels share; it cannot allocate."""
    return _compiled(function, counts_references=False)


def setup_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a `function` that allocates, with the flags of `kernel` but for that."""
    return _compiled(function, counts_references=True)


def _compiled(function: Callable[P, R], counts_references: bool) -> Callable[P, R]:
    settings: Any = numba.core.config
    before = settings.CACHE_DIR
    settings.CACHE_DIR = str(kernel_cache_dir())
    try:
        decorate: Any = numba.njit  # the stubs do not know `_nrt`
        compiled: Callable[P, R] = decorate(
            cache=True,
            fastmath=False,
            parallel=False,
            nogil=True,
            error_model="numpy",
            _nrt=counts_references,
        )(function)
    finally:
        settings.CACHE_DIR = before
    return compiled
