"""Processes of a node that host zones of sessions; each process hosts one part of the zones."""

from __future__ import annotations

import subprocess
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from cavmarl.core.huge_pages import huge_heap
from cavmarl.core.processes import start_python
from cavmarl.parallel.nodes.joining_nodes import ANYONE
from cavmarl.parallel.nodes.node_starters import NODE

Door = tuple[str, int, str]  # host, port, key


class ZoneProcesses:
    """The processes of a node that host zones."""

    def __init__(self) -> None:
        self._of: dict[Door, list[subprocess.Popen[Any]]] = {}

    def __len__(self) -> int:
        return sum(len(some) for some in self._of.values())

    def follow(self, tasks: Sequence[dict[str, Any]]) -> None:
        """Run as many processes as `ZoneNodes.tasks` lists; restart a process that has ended."""
        wanted = Counter((one["host"], one["port"], one["key"]) for one in tasks)
        for door in {*self._of, *wanted}:
            alive = [one for one in self._of.get(door, []) if one.poll() is None]
            for process in alive[wanted[door] :]:
                process.kill()
                process.wait()
            started = [_start(door) for _ in range(wanted[door] - len(alive))]
            self._of[door] = alive[: wanted[door]] + started
            if not self._of[door]:
                del self._of[door]

    def end(self) -> None:
        """End all processes."""
        self.follow([])


def _start(door: Door) -> subprocess.Popen[Any]:
    host, port, key = door
    words = ["-m", NODE, host, str(port), str(ANYONE)]
    process = start_python(words, huge_heap(), stdin=subprocess.PIPE, text=True)
    assert process.stdin is not None
    with suppress(BrokenPipeError), process.stdin as pipe:
        pipe.write(f"{key}\n")
    return process
