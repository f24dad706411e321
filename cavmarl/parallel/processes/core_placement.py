"""Placement of workers on cores: no two workers share a core while there are enough cores.

Operating systems put processes that wake together on one core, where one process waits for the
other. Moving one of them to a free core then takes the system many steps. A worker that shared a
core is kept off the cores of the other workers; the system may place it on any other core.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress

from cavmarl.parallel.processes.process_barrier import usable_cores

UNKNOWN = -1  # what `process_barrier.present_core` returns without the compiler


def homes(
    cores: Sequence[int],  # core where each process was seen
    usable: set[int],
) -> list[int]:  # different cores; empty if there are too few
    """Choose for each process the core where it was seen, or a free core if that one is taken."""
    free = sorted(usable - set(cores))
    found: list[int] = []
    for core in cores:
        if core in usable and core not in found:
            found.append(core)
        elif free:
            found.append(free.pop(0))
        else:
            return []
    return found


def keep_apart(
    pids: Sequence[int],  # ids of processes that work at the same time
    cores: Sequence[int],  # core where each process was seen; -1: unknown
) -> None:
    """Keep each process off the cores of the other processes, if two processes shared a core."""
    if len(set(cores)) == len(cores) or UNKNOWN in cores:
        return
    usable = usable_cores()
    found = homes(cores, usable)
    for pid, home in zip(pids, found, strict=False):
        # The pool notices a dead process. If this call is forbidden, the system places the process.
        with suppress(ProcessLookupError, PermissionError):
            os.sched_setaffinity(pid, usable - set(found) | {home})
