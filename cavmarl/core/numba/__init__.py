"""Compiled kernels: arrays and scalars in, arrays out. They know no object and no setting.

`kernel` is the one place for compiler flags: no fastmath (results must not depend on how a world is
divided), serial (processes give the parallelism), GIL released, cached on disk.

`kernel_cache` and `core/cache_folder.py` say where.
With `NUMBA_DISABLE_JIT=1` every kernel is plain Python.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numba
import numba.core.config

from cavmarl.core.numba.compiler import KernelCompiler, call_as_part
from cavmarl.core.numba.kernel_cache import KernelCache, kernel_cache_dir

__all__ = ["allocating_kernel", "inlined_kernel", "kernel", "kernel_cache_dir"]

P = ParamSpec("P")
R = TypeVar("R")


def _compile(function: Callable[P, R], **options: Any) -> Callable[P, R]:
    njit: Any = numba.njit
    compiled: Any = njit(
        fastmath=False,
        parallel=False,
        nogil=True,
        error_model="numpy",
        no_cfunc_wrapper=True,
        pipeline_class=KernelCompiler,
        **options,
    )(function)
    settings: Any = numba.core.config
    if not settings.DISABLE_JIT:
        compiled._cache = KernelCache(function)
        call_as_part(compiled)
    return compiled  # type: ignore[no-any-return]


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` with the flags that all kernels share.

    Its arrays are borrowed from the caller and never counted: with Numba's reference counts, an
    atomic addition for every access to a bundle of arrays, a tick takes ten times as long
    (decision 002). So it can neither make an array nor return one.
    """
    return _compile(function, _nrt=False)


def inlined_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """As `kernel`, but always compiled into its callers.

    For what is called for every vehicle: a call hands over each array of a bundle as seven numbers.
    """
    return _compile(function, _nrt=False, forceinline=True)


def allocating_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """As `kernel`, for those that make arrays or lists; none of them is part of a tick."""
    return _compile(function)
