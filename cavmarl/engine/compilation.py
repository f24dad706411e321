"""Compilation of kernels before they are needed, with messages to the user."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cavmarl.core.cache_folder import cache_dir, report_unwritable
from cavmarl.core.compiled import IS_PLAIN, sources_digest
from cavmarl.core.compiled.kernel_files import machine_digest, numba_version
from cavmarl.core.compiled.machine_code import CompileListener, kernel_source, listeners


class _Announcer(CompileListener):
    """Prints a message when the first kernel is compiled in this process."""

    def __init__(self) -> None:
        self.has_printed = False

    def on_compile(self, name: str) -> None:
        # Kernels of `parallel` are small, and workers compile them after the caller's message.
        is_long = name.startswith("cavmarl.") and not name.startswith("cavmarl.parallel.")
        if is_long and not self.has_printed:
            self.has_printed = True
            print(
                "cavmarl: compiling kernels that this world needs, once for this version and "
                "machine",
                file=sys.stderr,
                flush=True,
            )


_ANNOUNCER = _Announcer()


def prepare_kernels() -> None:
    """Compile the kernels of a plain world in two processes, if no kernels are cached here.

    Afterwards, the first compilation of a kernel in this process prints a message on standard
    error.
    """
    if _ANNOUNCER in listeners:
        return
    listeners.append(_ANNOUNCER)
    if compiled_before() or not numba_version() or _marker("plain").exists():
        return
    if not _can_cache():
        return
    print(
        "cavmarl: compiling the kernels of a first step, once for this version and machine: about "
        "40 s of processor time, shared by two processes",
        file=sys.stderr,
        flush=True,
    )
    command = [sys.executable, "-m", "cavmarl.prebuild", "compile"]
    if subprocess.run(command, check=False).returncode == 0:
        _write_marker(_marker("plain"))


def compiled_before() -> bool:
    """Return whether all kernels of this version are cached here, or need no compilation."""
    return IS_PLAIN or kernel_source().library is not None or _marker("complete").exists()


@contextmanager
def compiling_all() -> Iterator[None]:
    """Record at the end of the block that all kernels are compiled.

    The code in the block must call every kernel that a tick may need.
    """
    yield
    if not compiled_before():
        _write_marker(_marker("complete"))


def _marker(name: str) -> Path:
    return cache_dir() / "kernels" / sources_digest() / f"{machine_digest()}.{name}"


def _can_cache() -> bool:
    """Return whether compiled kernels can be cached on this machine; if not, report it once."""
    try:
        _marker("plain").parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        report_unwritable(error)
        return False
    return True


def _write_marker(marker: Path) -> None:
    if _can_cache():
        marker.touch()
