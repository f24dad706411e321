"""On which cores workers are: none shares one with another as long as there are enough of them.

Systems put processes that are woken together on one core, where one waits until the other is done,
and take many steps to notice that another core is free. A worker found there is kept off the
cores of the others; apart from that the system places it as it likes.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress

from cavmarl.parallel.processes.process_barrier import usable_cores

UNKNOWN = -1  # as `process_barrier.present_core` says it where nothing is compiled


def homes(
    cores: Sequence[int],  # where each has been found
    usable: set[int],  # all that there are
) -> list[int]:  # as many different cores, or none if there are not so many
    """A core for each process, where it has been unless one before it has been there, too."""
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
    pids: Sequence[int],  # of processes that work at the same time
    cores: Sequence[int],  # where each has been found; -1: unknown
) -> None:
    """Keep each of some processes off the cores of the others, if two have been on one."""
    if len(set(cores)) == len(cores) or UNKNOWN in cores:
        return
    usable = usable_cores()
    found = homes(cores, usable)
    for pid, home in zip(pids, found, strict=False):
        # Others notice that it is dead; where this is forbidden it goes where the system puts it.
        with suppress(ProcessLookupError, PermissionError):
            os.sched_setaffinity(pid, usable - set(found) | {home})
