"""Compiled kernels: arrays and scalars in, numbers out. They know no object and no setting.

`kernel` is the one place for compiler flags: no fastmath (results must not depend on how a world is
divided), serial (processes give the parallelism), GIL released, kept on disk.

With `NUMBA_DISABLE_JIT=1` every kernel is plain Python.
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
    """Compile `function` with the flags that all kernels share, when it is first called.

    Its arrays are borrowed from the caller and never counted: with Numba's reference counts, an
    atomic addition for every access to a bundle of arrays, a tick takes ten times as long
    (decision 002). So it can neither make an array nor return one.
    """
    return _make(function, is_inlined=False)


def inlined_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile as `kernel` does, but always into the callers of the function.

    For functions that are called for every vehicle: a call hands over each array of a bundle as
    seven numbers.
    """
    return _make(function, is_inlined=True)


def inlined_function(function: Callable[P, R]) -> Callable[P, R]:
    """Compile as `inlined_kernel` does, but only into kernels: Python runs the function itself.

    For small functions of numbers that must give Python the same bits as kernels.
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
