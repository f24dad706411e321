"""`InlinedFunction`: a small function that kernels inline and Python runs as it is."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, update_wrapper
from typing import Any


class InlinedFunction:
    """A function that is compiled into the kernels that call it, and plain Python in Python.

    A call from Python therefore needs no machine code.
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
        """The type of the function for Numba, which compiles a kernel that calls it."""
        return self._part._numba_type_
