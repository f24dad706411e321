"""Says when kernels are compiled: each when it is first used, and then kept on disk."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cavmarl.core.cache_folder import cache_dir, tell_unwritable
from cavmarl.core.compiled import IS_PLAIN, sources_digest
from cavmarl.core.compiled.code import Listener, listeners


class _Announcer(Listener):
    """Says so when the first kernel is compiled."""

    def __init__(self) -> None:
        self.has_told = False

    def on_compile(self, name: str) -> None:
        # Those of processes are small, and compiled in workers, after the caller has told.
        is_long = name.startswith("cavmarl.") and not name.startswith("cavmarl.parallel.")
        if is_long and not self.has_told:
            self.has_told = True
            print(
                "cavmarl: compiling the kernels that this world uses, once for this version: up to "
                "20 s of one core before the first observation, and as long in the first steps",
                file=sys.stderr,
                flush=True,
            )


_ANNOUNCER = _Announcer()


def announce_compilation() -> None:
    """From now on say on standard error when the first kernel is compiled in this process."""
    if _ANNOUNCER not in listeners:
        listeners.append(_ANNOUNCER)


def compiled_before() -> bool:
    """Whether all kernels of this version are on this machine, or are never compiled."""
    return IS_PLAIN or _marker().exists()


def _marker() -> Path:
    return cache_dir() / "kernels" / sources_digest() / "complete"


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
        _marker().parent.mkdir(parents=True, exist_ok=True)
        _marker().touch()
    except OSError as error:
        tell_unwritable(error)
    print(f" done in {time.perf_counter() - started:.0f} s", file=sys.stderr, flush=True)
