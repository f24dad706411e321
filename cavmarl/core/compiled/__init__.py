"""Compiled kernels: functions of arrays and scalars that use no objects and no settings.

`kernel` is the only place with compiler flags: no fastmath (results must not depend on the division
of a world), serial (processes provide the parallelism), GIL released, code cached on disk.

With `NUMBA_DISABLE_JIT=1`, every kernel is plain Python.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

from cavmarl.core.compiled.inlined_function import InlinedFunction
from cavmarl.core.compiled.kernel import IS_PLAIN, Kernel, specialized, unchecked
from cavmarl.core.compiled.sources import sources_digest

__all__ = [
    "IS_PLAIN",
    "inlined_function",
    "inlined_kernel",
    "kernel",
    "sources_digest",
    "specialized",
    "unchecked",
]

P = ParamSpec("P")
R = TypeVar("R")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` at its first call, with the flags that all kernels share.

    The function borrows its arrays from the caller, and no references are counted. With Numba's
    reference counts, an atomic addition for every access to a bundle of arrays, a tick takes ten
    times as long (decision 002). So a kernel can neither create an array nor return one.
    """
    return _make(function, is_inlined=False)


def inlined_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile as `kernel` does, but always inline the function into its callers.

    This is for functions that are called for every vehicle, because a call would pass each array of
    a bundle as seven numbers.
    """
    return _make(function, is_inlined=True)


def inlined_function(function: Callable[P, R]) -> Callable[P, R]:
    """Inline the function into kernels as `inlined_kernel` does, but leave it plain in Python.

    This is for small functions of numbers that must return the same bits in Python and in kernels.
    """
    if IS_PLAIN:
        return function
    made: Any = InlinedFunction(function)
    return made  # type: ignore[no-any-return]


def _make(function: Callable[P, R], is_inlined: bool) -> Callable[P, R]:
    if IS_PLAIN:
        return function
    made: Any = Kernel(function, is_inlined)
    return made  # type: ignore[no-any-return]
