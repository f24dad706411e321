"""Compiled kernels on disk: one file for each kernel and list of argument types.

A file's name has a digest of everything that its machine code depends on, so an outdated file is
never found. Its content is verified by a checksum; a damaged file is compiled again. Files are
written atomically, so processes may compile the same kernel at the same time.
"""

from __future__ import annotations

import hashlib
import json
import marshal
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from cavmarl.core.atomic_file import write_whole
from cavmarl.core.cache_folder import cache_dir, report_unwritable
from cavmarl.core.compiled.arguments import accepts
from cavmarl.core.compiled.sources import module_digest

if sys.platform != "win32":
    import fcntl

SUFFIX = ".kernel"
_DIGEST_BYTES = 32
_CONSTANTS = (bool, int, float, str, bytes, type(None))


class CompiledKernel(NamedTuple):
    """The machine code of a kernel for one list of argument types."""

    name: str  # the function, with its module
    types: str  # types of the arguments, see `arguments.ArgumentType`
    result: str  # type of the result, see `arguments.result_reader`
    symbol: str  # name of the entry point, the only symbol that the code defines
    code: bytes  # a relocatable ELF object


class KernelFile:
    """The file of one kernel for one list of argument types.

    Attributes:
        name: name of the function, with its module.
        types: types of the arguments.
        symbol: name of this kernel's entry point.
    """

    def __init__(self, function: Callable[..., Any], types: str) -> None:
        module, name = function.__module__, function.__qualname__
        self.name = f"{module}.{name}"
        self.types = types
        self._frozen = _frozen_values(function)
        line = str(function.__code__.co_firstlineno)
        kernel = _digest_of(module, name, line, self._frozen or "", *_machine())
        digest = _digest_of(types)
        self.symbol = f"cavmarl_{kernel}_{digest}"
        folder = cache_dir() / "kernels" / module_digest(module)
        readable = name.rpartition(".")[2].strip("<>")
        self._path = folder / f"{readable}.{kernel}.{digest}{SUFFIX}"
        self._pattern = f"{readable}.{kernel}.*{SUFFIX}"

    def load(self) -> CompiledKernel | None:
        """Return the kernel for these types, or for other types whose code accepts such arguments.

        Return None if there is no such file, or if all such files are damaged.
        """
        if self._frozen is None:
            return None
        others = sorted(self._path.parent.glob(self._pattern))
        for path in (self._path, *others):
            try:
                found = unpack(path.read_bytes())
            except OSError:
                continue
            if found is not None and accepts(found.types, self.types):
                return found
        return None

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from compiling this kernel; the lock ends with the process."""
        if self._frozen is None or sys.platform == "win32":
            yield
            return
        path = self._path.with_suffix(".lock")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError:  # `save` reports it
            yield
            return
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
        finally:
            path.unlink(missing_ok=True)
            os.close(lock)

    def save(self, kernel: CompiledKernel) -> None:
        """Write the file; if that fails, report it once and continue."""
        if self._frozen is None:
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self._path, pack(kernel))
        except OSError as error:
            report_unwritable(error)


def _digest_of(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


def pack(kernel: CompiledKernel) -> bytes:
    """Return the content of a kernel's file: a checksum, a description, the code."""
    about = json.dumps([kernel.name, kernel.types, kernel.result, kernel.symbol])
    body = about.encode() + b"\n" + kernel.code
    return hashlib.sha256(body).digest() + body


def unpack(content: bytes) -> CompiledKernel | None:
    """Return the kernel in the content of a file, or None if the content is damaged."""
    body = content[_DIGEST_BYTES:]
    if hashlib.sha256(body).digest() != content[:_DIGEST_BYTES]:
        return None
    about, _, code = body.partition(b"\n")
    name, types, result, symbol = json.loads(about)
    return CompiledKernel(name, types, result, symbol, code)


@cache
def _machine() -> tuple[str, ...]:
    """Return the compiler, the processor and the settings that determine machine code."""
    from llvmlite import binding

    processor = os.environ.get("NUMBA_CPU_NAME") or binding.get_host_cpu_name()
    features = os.environ.get("NUMBA_CPU_FEATURES")  # empty: the processor's name decides
    if features is None:
        features = binding.get_host_cpu_features().flatten()
    settings = [f"{name}={os.environ.get(name, '')}" for name in ("NUMBA_BOUNDSCHECK", "NUMBA_OPT")]
    return (numba_version(), processor, features, *settings)


@cache
def machine_digest() -> str:
    """Return a digest of the compiler, the processor and the settings of kernels."""
    return _digest_of(*_machine())


@cache
def numba_version() -> str:
    """Return the installed version of Numba, or an empty text."""
    try:
        return version("numba")
    except PackageNotFoundError:
        return ""


def _frozen_values(function: Callable[..., Any]) -> str | None:
    """Return a description of the constants of a kernel that is defined outside of the package.

    Numba turns closure variables into constants. Return None if one of them cannot be described;
    such a kernel is not cached.
    """
    if function.__module__.startswith("cavmarl."):
        return ""
    try:
        source = Path(function.__code__.co_filename).read_bytes()
    except OSError:  # code in a notebook, or in a text passed to exec
        source = marshal.dumps(function.__code__)
    values = []
    for cell in function.__closure__ or ():
        if not isinstance(cell.cell_contents, _CONSTANTS):
            return None
        values.append(repr(cell.cell_contents))
    return hashlib.sha256(source).hexdigest() + ",".join(values)
