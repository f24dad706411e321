"""Functions for kernels that are written in LLVM's instructions instead of Python."""

from __future__ import annotations

from collections.abc import Callable
from functools import update_wrapper
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


class Intrinsic:
    """A function that is plain Python in Python, and generated code in compiled kernels.

    Numba asks a global value for its `_numba_type_`, so Numba is imported only to compile.
    """

    def __init__(self, plain: Callable[..., Any], generate: Callable[..., Any]) -> None:
        update_wrapper(self, plain)
        self._plain = plain
        self._generate = generate
        self._type: Any = None

    def __call__(self, *arguments: Any) -> Any:
        return self._plain(*arguments)

    @property
    def _numba_type_(self) -> Any:
        if self._type is None:
            from numba.core import types
            from numba.core.typing.templates import make_intrinsic_template

            make: Any = make_intrinsic_template
            function: Any = types.Function
            self._type = function(make(self, self._generate, self._plain.__name__))
        return self._type


def intrinsic(generate: Callable[..., Any]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator for the plain Python form of an intrinsic.

    Args:
        generate: called with Numba's typing context and the types of the arguments; returns the
            signature and a function that generates code, as for `numba.extending.intrinsic`. It
            imports its dependencies from Numba and llvmlite itself.
    """

    def decorate(plain: Callable[P, R]) -> Callable[P, R]:
        made: Any = Intrinsic(plain, generate)
        return made  # type: ignore[no-any-return]

    return decorate
