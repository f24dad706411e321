"""The compiler of kernels: Numba's, except that an index counts from the front only.

In Python `a[-1]` is the last item, so Numba compares every signed index with zero before it reads.
In kernels -1 means nothing and is asked about before; leaving that comparison out makes a tick of
traffic a tenth faster (decision 008). A negative index that is written out, as in `a[-1]`, keeps
its meaning. With `NUMBA_BOUNDSCHECK=1` every index outside of its array, negative ones included,
is an `IndexError`: `make bounds` runs the tests so.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import ir
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering
from numba.core.types import intp
from numba.np import arrayobj

__all__ = ["KernelCompiler"]


@contextmanager
def _from_the_front() -> Iterator[None]:
    """While this is open, array accesses are made without the comparison.

    Numba compiles under one lock, so no other function is being lowered meanwhile.
    """
    usual: Any = arrayobj.fix_integer_index

    def fix(context: Any, builder: Any, index_type: Any, index: Any, size: Any) -> Any:
        if index_type.signed and not isinstance(index, ir.Constant):
            return context.cast(builder, index, index_type, intp)
        return usual(context, builder, index_type, index, size)

    arrayobj.fix_integer_index = fix
    try:
        yield
    finally:
        arrayobj.fix_integer_index = usual


_register: Any = register_pass


@_register(mutates_CFG=True, analysis_only=False)
class _KernelLowering(NativeLowering):
    _name = "kernel_lowering"

    def run_pass(self, state: Any) -> bool:
        lower: Any = super().run_pass
        with _from_the_front():
            return bool(lower(state))


class KernelCompiler(CompilerBase):
    """Numba's usual pipeline with `_KernelLowering` in it."""

    def define_pipelines(self) -> list[Any]:
        """The one pipeline."""
        builder: Any = DefaultPassBuilder
        manager = builder.define_nopython_pipeline(self.state)
        manager.passes[:] = [
            (_KernelLowering if step is NativeLowering else step, about)
            for step, about in manager.passes
        ]
        manager.finalize()
        return [manager]
