"""Sees to it that kernels are compiled before they are needed, and says so."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cavmarl.core.cache_folder import cache_dir, tell_unwritable
from cavmarl.core.compiled import IS_PLAIN, sources_digest
from cavmarl.core.compiled.kernel_files import machine_digest, numba_version
from cavmarl.core.compiled.machine_code import CompileListener, kernel_source, listeners


class _Announcer(CompileListener):
    """Says so when the first kernel is compiled in this process."""

    def __init__(self) -> None:
        self.has_told = False

    def on_compile(self, name: str) -> None:
        # Those of processes are small, and compiled in workers, after the caller has told.
        is_long = name.startswith("cavmarl.") and not name.startswith("cavmarl.parallel.")
        if is_long and not self.has_told:
            self.has_told = True
            print(
                "cavmarl: compiling kernels that this world needs, once for this version and "
                "machine",
                file=sys.stderr,
                flush=True,
            )


_ANNOUNCER = _Announcer()


def prepare_kernels() -> None:
    """Compile the kernels of a plain world in two processes, if none are kept on this machine.

    From now on say on standard error when a kernel is compiled in this process.
    """
    if _ANNOUNCER in listeners:
        return
    listeners.append(_ANNOUNCER)
    if compiled_before() or not numba_version() or _marker("plain").exists():
        return
    if not _can_keep():
        return
    print(
        "cavmarl: compiling the kernels of a first step, once for this version and machine: about "
        "40 s of processor time, shared by two processes",
        file=sys.stderr,
        flush=True,
    )
    command = [sys.executable, "-m", "cavmarl.prebuild", "compile"]
    if subprocess.run(command, check=False).returncode == 0:
        _leave(_marker("plain"))


def compiled_before() -> bool:
    """Return whether all kernels of this version are on this machine, or are never compiled."""
    return IS_PLAIN or kernel_source().library is not None or _marker("complete").exists()


@contextmanager
def compiling_all() -> Iterator[None]:
    """Note that all kernels are compiled when the block ends.

    What runs inside has to call every kernel that a tick may need.
    """
    yield
    if not compiled_before():
        _leave(_marker("complete"))


def _marker(name: str) -> Path:
    return cache_dir() / "kernels" / sources_digest() / f"{machine_digest()}.{name}"


def _can_keep() -> bool:
    """Return whether compiled kernels can be kept on this machine; if not, say so once."""
    try:
        _marker("plain").parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        tell_unwritable(error)
        return False
    return True


def _leave(marker: Path) -> None:
    if _can_keep():
        marker.touch()
