"""Calls that are made again and again, with arguments of the same types every time.

Before each call Numba finds out the type of every argument, and of every array in a bundle: in a
small world that takes longer than what the kernel does (decision 008).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numba
import numba.core.config

P = ParamSpec("P")
R = TypeVar("R")


def repeated(kernel: Callable[P, R]) -> Callable[P, R]:
    """A kernel for one caller whose arguments are of the same types in every call.

    The types are those of the first call; what later calls pass is taken for the same unseen. So it
    is for arrays that the caller owns, or has made itself. They are given by position.

    With `NUMBA_DISABLE_JIT=1` or `NUMBA_BOUNDSCHECK=1` it is the kernel itself.
    """
    settings: Any = numba.core.config
    if settings.DISABLE_JIT or settings.BOUNDSCHECK:
        return kernel
    call: Any = _Repeated(kernel)
    return call  # type: ignore[no-any-return]


class _Repeated:
    """Calls what Numba has compiled for the types of the first call."""

    __slots__ = ("_compiled", "_kernel")

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel
        self._compiled: Callable[..., Any] | None = None

    def __call__(self, *arguments: Any) -> Any:
        compiled = self._compiled
        if compiled is None:
            types: Any = tuple(map(numba.typeof, arguments))
            self._compiled = compiled = self._kernel.compile(types)
        return compiled(*arguments)
