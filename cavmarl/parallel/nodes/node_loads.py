"""`NodeLoad`: what a node has done and has, over a window of ticks."""

from __future__ import annotations

import os
import resource
import socket
import time
from collections.abc import Sequence
from dataclasses import astuple
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from cavmarl.balance.probe import Watch
from cavmarl.engine.simulation import Simulation
from cavmarl.parallel.nodes.links import Links

TOTALS = 7  # numbers that a node says of itself
TO_SHOW, TO_BALANCE = "to show", "to balance"  # for what nodes are asked about their machines


class NodeLoad(NamedTuple):
    """Of one node, since it was asked last."""

    node: int  # its number
    ticks: int  # of the worlds in this time
    cpu_s: float  # time of the processor
    waited_s: float  # time in which it waited for frames
    sent_bytes: int  # to other nodes and to the caller
    sent_frames: int  # the same
    memory_bytes: int  # resident now
    vehicles: int  # that it owns now, in all worlds
    ghosts: int  # copies of other zones' vehicles that it has now


class MachineAsked(NamedTuple):
    """What nodes are asked about their machines."""

    purpose: str  # those that ask for another one do not change the time that it is about
    processes: dict[str, list[int]]  # machine → those of this run on it, as nodes have said


class MachineWatch:
    """How busy other programs than this run keep this machine."""

    def __init__(self) -> None:
        self._watch = _watch([])

    def since(self, pids: Sequence[int]) -> list[Any]:
        """Shares as of `Utilisation`, and their source, since this was asked last, or first.

        Args:
            pids: the run's processes on this machine from now on.
        """
        found, self._watch = self._watch.snapshot(), _watch(pids)
        return [astuple(found.workers[0].use), found.gpu_source]


def _watch(pids: Sequence[int]) -> Watch:
    """The first one is this process."""
    return Watch(dict(enumerate(dict.fromkeys((os.getpid(), *pids)))))


@cache
def machine_watch(purpose: str) -> MachineWatch:
    """That of this process for a purpose."""
    return MachineWatch()


def told_of(payload: Any, links: Links, simulation: Simulation, zones: Sequence[int]) -> list[Any]:
    """What a node is asked for: of its machine, or of itself."""
    if payload is not None:
        asked = MachineAsked(*payload)
        return machine_watch(asked.purpose).since(asked.processes.get(socket.gethostname(), ()))
    return totals(links, simulation, zones)


def totals(links: Links, simulation: Simulation, zones: Sequence[int]) -> list[Any]:
    """What a node says of itself: the fields from `cpu_s` on, the first four since it began."""
    zoned = simulation.division.zoned
    vehicles = int(zoned.num_owned[list(zones)].sum())
    return [
        time.process_time(),
        links.waited_s,
        links.sent_bytes,
        links.sent_frames,
        _resident_bytes(),
        vehicles,
        int(zoned.num_rows[list(zones)].sum()) - vehicles,
    ]


def since(node: int, ticks: int, now: Sequence[Any], before: Sequence[Any] | None) -> NodeLoad:
    """What a node has done since it said something else; None: since it began."""
    sums = now[:4] if before is None else [a - b for a, b in zip(now, before[:4], strict=False)]
    return NodeLoad(node, ticks, *sums, *now[4:])


def _resident_bytes() -> int:
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024  # the most there was
