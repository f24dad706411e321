"""Compiled kernels: arrays and scalars in, arrays out. They know no object and no setting.

`kernel` is the one place for compiler flags: no fastmath (results must not depend on how a world is
divided), serial (processes give the parallelism), GIL released, cached on disk.

The cache has a folder for each file of kernels, named after its content and that of the files that
it imports: Numba itself only watches the file that defines a function, not the functions which that
one calls, and would hand out stale code. Set `CAVMARL_CACHE_DIR` to move it (default:
`~/.cache/cavmarl`). With `NUMBA_DISABLE_JIT=1` every kernel is plain Python.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba
import numba.core.config

from cavmarl.core.numba.compiler import KernelCompiler

__all__ = ["allocating_kernel", "cache_dir", "inlined_kernel", "kernel", "kernel_cache_dir"]

# Every import of one file of kernels by another; a test holds that there is no other form of it.
_IMPORT = re.compile(rb"^from cavmarl\.([\w.]+) import ", re.MULTILINE)
_PACKAGE = Path(__file__).parents[2]
_SHARED = ("core.numba", "core.numba.compiler")  # in the digest of every file

P = ParamSpec("P")
R = TypeVar("R")


def cache_dir() -> Path:
    """The folder for everything cavmarl keeps between runs (compiled kernels, converted maps)."""
    home = os.environ.get("CAVMARL_CACHE_DIR")
    return Path(home) if home else Path.home() / ".cache" / "cavmarl"


@cache
def kernel_cache_dir() -> Path:
    """The folder that stands for this version: one per content of all kernel sources.

    And one for those that check their indices (`NUMBA_BOUNDSCHECK=1`).
    """
    return _folder_of(_sources())


@cache
def _sources() -> dict[str, bytes]:
    """The content of each file of kernels, by its dotted name within the package."""
    folders = [
        *_PACKAGE.rglob("kernels"),
        *(_PACKAGE / "core" / n for n in ("math", "numba", "records")),
    ]
    return {_name_of(path): path.read_bytes() for folder in folders for path in folder.glob("*.py")}


def _name_of(path: Path) -> str:
    parts = path.relative_to(_PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def _cache_dir_of(module: str) -> Path:
    """Where the kernels of a module are kept; those of a module outside of this package, too."""
    sources = _sources()
    name = module.removeprefix("cavmarl.")
    if name not in sources:
        return kernel_cache_dir()
    found, to_read = set(_SHARED), [name]
    while to_read:
        name = to_read.pop()
        if name not in found:
            found.add(name)
            to_read += [other.decode() for other in _IMPORT.findall(sources[name])]
    return _folder_of({name: sources[name] for name in found})


def _folder_of(sources: dict[str, bytes]) -> Path:
    settings: Any = numba.core.config
    digest = hashlib.sha256(f"{numba.__version__} {settings.BOUNDSCHECK}".encode())
    for name, content in sorted(sources.items()):
        digest.update(f"{name}.py".encode() + b"\0" + content)
    return cache_dir() / "kernels" / digest.hexdigest()[:16]


def _compile(function: Callable[P, R], **options: Any) -> Callable[P, R]:
    settings: Any = numba.core.config
    before = settings.CACHE_DIR
    settings.CACHE_DIR = str(_cache_dir_of(function.__module__))
    try:
        njit: Any = numba.njit
        compiled: Callable[P, R] = njit(
            cache=True, fastmath=False, parallel=False, nogil=True, error_model="numpy", **options
        )(function)
    finally:
        settings.CACHE_DIR = before
    return compiled


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` with the flags that all kernels share.

    Its arrays are borrowed from the caller and never counted: with Numba's reference counts, an
    atomic addition for every look into a bundle of arrays, a tick takes ten times as long
    (decision 002). So it can neither make an array nor return one.
    """
    return _compile(function, _nrt=False, pipeline_class=KernelCompiler)


def inlined_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """As `kernel`, but always compiled into its callers.

    For what is called for every vehicle: a call hands over each array of a bundle as seven numbers.
    """
    return _compile(function, _nrt=False, pipeline_class=KernelCompiler, forceinline=True)


def allocating_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """As `kernel`, for those that make arrays or lists; none of them is part of a tick."""
    return _compile(function)
