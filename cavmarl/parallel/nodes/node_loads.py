"""`NodeLoad`: the load of a node over a window of ticks."""

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

TOTALS = 7  # count of the numbers that a node reports about itself
TO_SHOW, TO_BALANCE = "to show", "to balance"  # purposes of requests about the load of machines
LINKS = "links"  # purpose of a request about connections


class NodeLoad(NamedTuple):
    """The load of a node since the previous request."""

    node: int  # number of the node
    ticks: int  # simulated ticks
    cpu_s: float  # processor time
    waited_s: float  # time spent waiting for frames
    sent_bytes: int  # to other nodes and to the caller
    sent_frames: int  # to other nodes and to the caller
    memory_bytes: int  # resident now
    vehicles: int  # owned now, in all worlds
    ghosts: int  # copies of vehicles of other zones, now


class MachineAsked(NamedTuple):
    """A request about the machines of nodes."""

    purpose: str  # the load counts since the previous request for the same purpose
    processes: dict[str, list[int]]  # machine → processes of this run on it


class MachineWatch:
    """Measures how busy other programs keep this machine."""

    def __init__(self) -> None:
        self._watch = _watch([])

    def since(self, pids: Sequence[int]) -> list[Any]:
        """Return the used shares since the previous call, and the source of the GPU's value.

        The shares are the fields of `Utilisation`: CPU, RAM and GPU.

        Args:
            pids: processes of this run on this machine from now on.
        """
        found, self._watch = self._watch.snapshot(), _watch(pids)
        return [astuple(found.workers[0].use), found.gpu_source]


def _watch(pids: Sequence[int]) -> Watch:
    """Watch this process and these processes."""
    return Watch(dict(enumerate(dict.fromkeys((os.getpid(), *pids)))))


@cache
def machine_watch(purpose: str) -> MachineWatch:
    """Return the watch of this process for a purpose."""
    return MachineWatch()


def load_report(
    payload: Any, links: Links, simulation: Simulation, zones: Sequence[int]
) -> list[Any]:
    """Return what the payload requests.

    `payload`: None: the load of this node (`totals`). A `MachineAsked`: the load of this machine
    or, for the purpose `LINKS`, the quality of the connections.
    """
    if payload is not None:
        asked = MachineAsked(*payload)
        if asked.purpose == LINKS:
            return [[number, *found] for number, found in links.qualities()]
        return machine_watch(asked.purpose).since(asked.processes.get(socket.gethostname(), ()))
    return totals(links, simulation, zones)


def totals(links: Links, simulation: Simulation, zones: Sequence[int]) -> list[Any]:
    """Return the fields of `NodeLoad`, starting with `cpu_s`; the first four are totals."""
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
    """Return the load since an earlier report; None: since the start of the node."""
    sums = now[:4] if before is None else [a - b for a, b in zip(now, before[:4], strict=False)]
    return NodeLoad(node, ticks, *sums, *now[4:])


def _resident_bytes() -> int:
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024  # the maximum so far
