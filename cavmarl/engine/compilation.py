"""Says when kernels are compiled: each when it is first used, and then kept on disk."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numba.core.config
from numba.core import event

from cavmarl.core.cache_folder import tell_unwritable
from cavmarl.core.numba import kernel_cache_dir

_Listener: Any = event.Listener


class _Announcer(_Listener):  # type: ignore[misc]
    """Told of each function that Numba compiles in this process; says so at the first kernel."""

    def __init__(self) -> None:
        self.listens = False
        self.has_told = False

    def on_start(self, event: Any) -> None:
        module = event.data["dispatcher"].py_func.__module__
        # Those of processes are small, and compiled in workers, after the caller has told.
        is_long = module.startswith("cavmarl.") and not module.startswith("cavmarl.parallel.")
        if is_long and not self.has_told:
            self.has_told = True
            print(
                "cavmarl: compiling the kernels that this world uses, once for this version: up to "
                "20 s of one core before the first observation, and as long in the first steps",
                file=sys.stderr,
                flush=True,
            )

    def on_end(self, event: Any) -> None:
        """Called by Numba."""


_ANNOUNCER = _Announcer()


def announce_compilation() -> None:
    """From now on say on standard error when the first kernel is compiled in this process."""
    if not _ANNOUNCER.listens:
        _ANNOUNCER.listens = True
        register: Any = event.register
        register("numba:compile", _ANNOUNCER)


def compiled_before() -> bool:
    """Whether all kernels of this version are on this machine, or are never compiled."""
    settings: Any = numba.core.config
    return bool(settings.DISABLE_JIT) or (kernel_cache_dir() / "complete").exists()


@contextmanager
def compiling_all() -> Iterator[None]:
    """Say that all kernels are compiled, and note it when that is done.

    What runs inside has to call every kernel that a tick may need.
    """
    if compiled_before():
        yield
        return
    print(
        "cavmarl: compiling all kernels of a tick, once for this version (about a minute of one "
        "core) …",
        end="",
        file=sys.stderr,
        flush=True,
    )
    started = time.perf_counter()
    _ANNOUNCER.has_told = True
    yield
    try:
        kernel_cache_dir().mkdir(parents=True, exist_ok=True)
        (kernel_cache_dir() / "complete").touch()
    except OSError as error:
        tell_unwritable(error)
    print(f" done in {time.perf_counter() - started:.0f} s", file=sys.stderr, flush=True)
