"""`InlinedFunction`: a small function, compiled into kernels; for Python it stays plain Python."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, update_wrapper
from typing import Any


class InlinedFunction:
    """A function that is compiled into the kernels that call it, and plain Python for Python.

    A call from Python therefore needs no machine code of the function.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        update_wrapper(self, function)
        self.py_func = function

    def __call__(self, *arguments: Any) -> Any:
        return self.py_func(*arguments)

    @cached_property
    def _part(self) -> Any:
        from cavmarl.core.compiled.compiler import make_part

        return make_part(self.py_func, is_inlined=True)

    @property
    def _numba_type_(self) -> Any:
        """The function as Numba sees it while it compiles a kernel that calls it."""
        return self._part._numba_type_
