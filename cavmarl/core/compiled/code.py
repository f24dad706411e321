"""The machine code of kernels in this process: from the package's library, the disk, or Numba.

`CAVMARL_KERNELS` says where code may come from. `prebuilt`: only from the library in the wheel,
`native`: compiled for this processor, `auto` (the default): from the library where it can be used,
else compiled. Compiled code is kept on disk.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from cavmarl.core.compiled.arguments import ArgumentType
from cavmarl.core.compiled.store import CompiledKernel, KernelFile, numba_version
from cavmarl.core.compiled.tables import tables
from cavmarl.core.errors import KernelError

SOURCES = ("auto", "prebuilt", "native")
SETTING = "CAVMARL_KERNELS"

_ENTRY: Any = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p)  # releases the GIL


class Code(NamedTuple):
    """A kernel that can be entered, for one list of argument types."""

    enter: Callable[[int], int]  # takes the address of `Words`, returns 0 or an error's number
    result: str


class Listener:
    """Is told when this process compiles kernels; `engine.compilation` shows progress."""

    def on_compile(self, name: str) -> None:
        """Called before a kernel is compiled."""


listeners: list[Listener] = []


def kernel_source() -> str:
    """Return what `CAVMARL_KERNELS` says, one of `SOURCES`.

    Raises:
        KernelError: it says something else.
    """
    chosen = os.environ.get(SETTING) or "auto"
    if chosen not in SOURCES:
        raise KernelError(f"{SETTING}={chosen}: must be one of {', '.join(SOURCES)}")
    return chosen


def find_code(
    function: Callable[..., Any], arguments: tuple[Any, ...], types: tuple[ArgumentType, ...]
) -> Code:
    """Return the code of a kernel for the types of some arguments.

    Raises:
        KernelError: the kernel has to be compiled, and may or can not be.
    """
    text = ";".join(kind.text for kind in types)
    file = KernelFile(function, text)
    kernel = file.load()
    if kernel is None:
        kernel = _compile(function, arguments, file.symbol)
        file.save(kernel)
    return Code(_ENTRY(_load_object(kernel)), kernel.result)


def _compile(
    function: Callable[..., Any], arguments: tuple[Any, ...], symbol: str
) -> CompiledKernel:
    if not numba_version():
        raise KernelError("todo")
    from cavmarl.core.compiled.compiler import compile_kernel

    name = f"{function.__module__}.{function.__qualname__}"
    for listener in listeners:
        listener.on_compile(name)
    return compile_kernel(function, arguments, symbol)


@cache
def _engine() -> Any:
    """Return LLVM's loader of object files."""
    from llvmlite import binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    machine = binding.Target.from_triple(binding.get_process_triple()).create_target_machine(
        opt=0, jit=True
    )
    return binding.create_mcjit_compiler(binding.parse_assembly(""), machine)


def _load_object(kernel: CompiledKernel) -> int:
    """Load an ELF object into this process and return the address of its entry point."""
    from llvmlite import binding

    for table in tables:
        binding.add_symbol(table.symbol, table.address)
    engine = _engine()
    engine.add_object_file(binding.ObjectFileRef.from_data(kernel.code))
    engine.finalize_object()
    address: int = engine.get_function_address(kernel.symbol)
    return address
