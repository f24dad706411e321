"""`JoiningNodes`: nodes that have called and do not host zones yet."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cavmarl.core.errors import MessageError, WorkerError, WorkerFailureError
from cavmarl.ownership.decisions import Neighbours
from cavmarl.parallel.network.code_stamp import code_stamp
from cavmarl.parallel.network.transport import Place, TransportListener
from cavmarl.parallel.nodes.link import FrameKind, Link, NodeFrame, read_list
from cavmarl.parallel.nodes.links import Links
from cavmarl.parallel.nodes.node_cuts import read_neighbours
from cavmarl.parallel.nodes.node_files import WorldFile
from cavmarl.parallel.nodes.node_system import MACHINE, NodeSystem
from cavmarl.parallel.nodes.peer_faults import LinkLostError, check_indices, read_json, reading
from cavmarl.parallel.worlds.world_errors import original_error

log = logging.getLogger("cavmarl.nodes")

LOOK_MS = 20.0  # time between checks for callers, before the worlds start
END_S = 1.0  # time for waiting nodes to end
MOST_PORTS = 1 << 16
ANYONE = (1 << 32) - 1  # number of a node that accepts any number


@dataclass
class JoiningNode:
    """A node that has called."""

    asked: int  # the number that it was started with, or ANYONE
    machine: str = "a machine"
    pid: int = 0  # process id on the machine of the node
    is_accepted: bool = False  # whether the node runs the same code as the caller
    place: Place | None = None  # where other nodes can call, once it has loaded the world
    neighbours: Neighbours | None = None  # zones between which vehicles change, in that world


class JoiningNodes:
    """Accepts nodes, sends them the world to load, and waits until they are ready.

    Attributes:
        place: where nodes call.
        ready: nodes that have loaded the world, by the numbers of their connections.
        refused: why other nodes were rejected.
        failures: exceptions of nodes that loaded the world.
        dropped: accepted nodes that have sent a bad frame, and have to be started again.
    """

    def __init__(
        self,
        listener: TransportListener,
        job: Any,  # JSON value for the nodes
        files: Sequence[WorldFile],  # files of the world
        room: Callable[[], int],  # returns the number of further nodes that can be used
        zones: int,  # number of zones of each world
        system: NodeSystem = MACHINE,
    ) -> None:
        self._listener = listener
        self._job = json.dumps({**job, "files": files}).encode()
        self._files = files
        self._room, self._zones = room, zones
        self._links = Links(self._receive, system)
        self.place = "{}:{}".format(*listener.place)
        self._all: dict[int, JoiningNode] = {}
        self._next = 0
        self.ready: list[int] = []
        self.refused: list[str] = []
        self.failures: list[WorkerFailureError] = []
        self.dropped: list[JoiningNode] = []

    def look(self, wait_ms: float) -> None:
        """Accept calls, and receive frames of earlier callers."""
        for asked, connection in self._listener.admit():
            self._all[self._next] = JoiningNode(asked)
            self._links.add(self._next, connection)
            self._next += 1
        try:
            self._links.pump(wait_ms)
            for number in list(self._all):
                frame = self._links.receive_if_there(number)
                if frame is not None:
                    self._receive(number, frame)
        except LinkLostError as lost:
            self._drop(lost)

    def await_ready(
        self,
        num: int,
        timeout_s: float,
        trouble: Callable[[], str | None],  # returns why a node will never join; None: no reason
    ) -> None:
        """Wait until this number of nodes is ready.

        Raises:
            CavmarlError: a node has raised this error.
            WorkerError: the nodes have not joined in time.
        """
        until_s = self._links.now_s() + timeout_s
        log.info("waiting for %d nodes at %s", num, self.place)
        while len(self.ready) < num:
            self.look(LOOK_MS)
            for failure in self.failures:
                raise original_error(failure) from failure
            why = trouble()
            if why is None and self._links.now_s() > until_s:
                why = "; refused ".join(
                    (
                        f"{len(self.ready)} of {num} nodes have joined at {self.place} within "
                        f"workers.join_timeout_s = {timeout_s:g}",
                        *self.refused,
                    )
                )
                why += "; start more nodes (cavmarl node --help), or raise workers.join_timeout_s"
            if why is not None:
                raise WorkerError(why)

    def asked(self, number: int) -> int:
        """Return the number with which a node was started."""
        return self._all[number].asked

    def take(self, number: int) -> tuple[JoiningNode, Link]:
        """Remove a ready node, and return it with its connection."""
        self.ready.remove(number)
        return self._all.pop(number), self._links.release(number)

    def _receive(self, number: int, frame: NodeFrame) -> None:
        node = self._all.get(number)
        if node is None:  # the node was rejected
            return
        try:
            with reading(number):
                self._apply(number, node, frame)
        except LinkLostError as lost:
            log.warning("a caller is rejected: %s", lost)
            self._drop(lost)

    def _apply(self, number: int, node: JoiningNode, frame: NodeFrame) -> None:
        match frame.kind:
            case FrameKind.JOIN if not node.is_accepted:
                self._examine(number, node, read_json(frame.data, dict))
            case FrameKind.WANTED if node.is_accepted:
                self._send_files(number, read_list(frame))
            case FrameKind.READY if node.is_accepted and node.place is None:
                host, port, near, may_teleport = read_list(frame)
                node.neighbours = read_neighbours([near, may_teleport], self._zones)
                check_indices("port", [port], MOST_PORTS)
                node.place = str(host), port
                self.ready.append(number)
            case FrameKind.FAILED:
                name, text, trace = map(str, read_list(frame))
                where = f"node on {node.machine}"
                failure = WorkerFailureError(node.asked, where, name, text, trace)
                self.failures.append(failure)
                log.warning("%s", failure)
                self._forget(number)
            case _:
                raise MessageError(f"a frame of kind {frame.kind.name} is out of turn")

    def _examine(self, number: int, node: JoiningNode, join: dict[str, Any]) -> None:
        node.machine, node.pid = (
            str(join["machine"]),
            int(join["pid"]),
        )
        if join["code"] != code_stamp():
            why = (
                f"it runs {join['code']}, the caller runs {code_stamp()}: install the same "
                "versions on all machines, since results would differ"
            )
        elif self._room() <= sum(each.is_accepted for each in self._all.values()):
            why = "no more nodes are needed: all zones have a node, and a spare node waits"
        else:
            node.is_accepted = True
            self._links.send(number, FrameKind.JOB, 0, [self._job])
            return
        self.refused.append(f"a node on {node.machine}: {why}")
        log.warning("refused %s", self.refused[-1])
        self._links.send(number, FrameKind.REFUSED, 0, [why.encode()])
        self._forget(number)

    def _send_files(self, number: int, wanted: Sequence[int]) -> None:
        check_indices("file", wanted, len(self._files))
        contents = [Path(self._files[n].path).read_bytes() for n in wanted]
        head = json.dumps([len(content) for content in contents]).encode()
        size = len(head).to_bytes(8, "little")
        self._links.send(number, FrameKind.FILES, 0, [size, head, *contents])

    def _drop(self, lost: LinkLostError) -> None:
        """Forget a caller; note it if it is a node that has sent a bad frame."""
        node = self._all.get(lost.peer)
        if node is not None and node.is_accepted and lost.fault:
            self.dropped.append(node)
        self._forget(lost.peer)

    def _forget(self, number: int) -> None:
        self._links.drop(number)
        self._all.pop(number, None)
        if number in self.ready:
            self.ready.remove(number)

    def close(self) -> None:
        """Dismiss all waiting nodes, and stop listening."""
        self._links.end(END_S)
        self._listener.close()
