"""The machine code of kernels in this process: from the wheel's library, the disk, or Numba.

`CAVMARL_KERNELS` selects the source of code for the package's kernels. `prebuilt`: only the
library; `native`: compiled for this processor; `auto` (the default): the library if it can be
used, otherwise compiled. Compiled code is cached on disk. Kernels of modules outside of the package
are always compiled.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from cavmarl.core.compiled.address_tables import tables
from cavmarl.core.compiled.arguments import ArgumentType
from cavmarl.core.compiled.kernel_files import CompiledKernel, KernelFile, numba_version
from cavmarl.core.compiled.library import Library, UnusableLibraryError
from cavmarl.core.compiled.sources import module_digest
from cavmarl.core.errors import KernelError

SETTING = "CAVMARL_KERNELS"
CHOICES = ("auto", "prebuilt", "native")

_ENTRY: Any = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p)  # its calls release the GIL
_INSTALL = "pip install '.[compile]' in a checkout of cavmarl"


class Code(NamedTuple):
    """The code of a kernel for one list of argument types."""

    address: int  # entry point
    enter: Callable[[int], int]  # takes the address of `Words`, returns 0 or an error's number
    result: str


class CompileListener:
    """Base of listeners for compilations in this process."""

    def on_compile(self, name: str) -> None:
        """Handle the compilation of the kernel of that name, which begins now."""


listeners: list[CompileListener] = []


class Source(NamedTuple):
    """The source of code for the package's kernels."""

    choice: str  # one of `CHOICES`
    library: Library | None
    reason: str  # why there is no library, as a clause


@cache
def kernel_source() -> Source:
    """Return the source of code, according to `CAVMARL_KERNELS` and this machine.

    Raises:
        KernelError: the setting has another value, or requires a library that cannot be used.
    """
    choice = os.environ.get(SETTING) or "auto"
    if choice not in CHOICES:
        raise KernelError(f"{SETTING}={choice}: must be one of {', '.join(CHOICES)}")
    if choice == "native":
        return Source(choice, None, f"{SETTING} is native")
    if os.environ.get("NUMBA_BOUNDSCHECK", "0") not in ("", "0"):
        return Source(choice, None, "NUMBA_BOUNDSCHECK is set")
    try:
        return Source(choice, Library(), "")
    except UnusableLibraryError as error:
        if choice == "prebuilt":
            raise KernelError(
                f"{SETTING}=prebuilt: there are no compiled kernels to use, as {error}; set "
                f"{SETTING}=auto to compile them"
            ) from error
        return Source(choice, None, str(error))


def find_code(
    function: Callable[..., Any], arguments: tuple[Any, ...], types: tuple[ArgumentType, ...]
) -> Code:
    """Return the code of a kernel for the types of some arguments.

    Raises:
        KernelError: the kernel must be compiled, which is not allowed or not possible.
    """
    text = ";".join(kind.text for kind in types)
    name = f"{function.__module__}.{function.__qualname__}"
    reason = "wheels contain no kernels of other packages"
    if name.startswith("cavmarl."):
        source = kernel_source()
        reason = source.reason
        if source.library is not None:
            found = source.library.find(name, text, module_digest(function.__module__))
            if found is not None:
                return Code(found.address, _ENTRY(found.address), found.result)
            reason = f"the wheel does not contain it for arguments of the types {text}"
        if source.choice == "prebuilt":
            raise KernelError(
                f"{SETTING}=prebuilt: the kernel {name} would have to be compiled, as {reason}; "
                f"set {SETTING}=auto to allow that"
            )
    if not numba_version():
        raise KernelError(
            f"the kernel {name} has to be compiled, as {reason}, and Numba is not installed: "
            f"{_INSTALL}"
        )
    return _compiled(KernelFile(function, text), function, arguments, reason)


def _compiled(
    file: KernelFile, function: Callable[..., Any], arguments: tuple[Any, ...], reason: str
) -> Code:
    """Return the code of a kernel from the disk, or compile and store it."""
    kernel = file.load()
    if kernel is None:
        with file.locked():  # another process may be compiling it
            kernel = file.load()
            if kernel is None:
                explain(reason)
                kernel = _compile(file, function, arguments)
                file.save(kernel)
    address = _load_object(kernel)
    return Code(address, _ENTRY(address), kernel.result)


def _compile(
    file: KernelFile, function: Callable[..., Any], arguments: tuple[Any, ...]
) -> CompiledKernel:
    from cavmarl.core.compiled.compiler import compile_kernel

    for listener in listeners:
        listener.on_compile(file.name)
    result, code = compile_kernel(function, arguments, file.symbol)
    return CompiledKernel(file.name, file.types, result, file.symbol, code)


@cache
def explain(reason: str) -> None:
    """Report once why a kernel is compiled although the wheel has compiled kernels."""
    if kernel_source().choice == "auto" and Library.is_there():
        print(
            f"cavmarl: a kernel is compiled on this machine, as {reason}",
            file=sys.stderr,
            flush=True,
        )


_LOADED: dict[str, int] = {}  # addresses of entry points, by symbol


@cache
def _engine() -> Any:
    """Return LLVM's loader of object files."""
    from llvmlite import binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    target = binding.Target.from_triple(binding.get_process_triple())
    machine = target.create_target_machine(opt=0, jit=True)
    # Code refers to its data by 32-bit offsets, so both must be in one piece of memory.
    return binding.create_mcjit_compiler(binding.parse_assembly(""), machine, use_lmm=True)


def _load_object(kernel: CompiledKernel) -> int:
    """Load an ELF object into this process once, and return the address of its entry point."""
    if kernel.symbol in _LOADED:
        return _LOADED[kernel.symbol]
    from llvmlite import binding

    for table in tables:
        binding.add_symbol(table.symbol, table.address)
    engine = _engine()
    engine.add_object_file(binding.ObjectFileRef.from_data(kernel.code))
    engine.finalize_object()
    address: int = engine.get_function_address(kernel.symbol)
    _LOADED[kernel.symbol] = address
    return address
