"""`NodeWatch`: finds out which node is lost if a node is silent or others cannot reach it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import TypeVar

from cavmarl.core.errors import MessageError, WorkerError
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame, read_list
from cavmarl.parallel.nodes.links import Links, SilenceError
from cavmarl.parallel.nodes.peer_faults import LinkLostError, check_indices

LOOK_S = 0.5  # time between checks; a process that is stopped at two checks is given up
PONG_S = 1.0  # time for a living node to answer a PING
MISSED_S = 0.1  # time to collect reports of lost connections
VAIN = 5  # number of PINGs that all nodes answer before an unfinished command fails

MOST_NODES = 1 << 32

Found = TypeVar("Found")


class SilentNodeError(LinkLostError):
    """A node is silent, or another node waits for it in vain; its process may still run."""


class NodeWatch:
    """Watches the nodes at the other ends of `links`."""

    def __init__(
        self,
        links: Links,
        stopped: Callable[[], set[int]],  # returns the nodes whose processes are stopped
    ) -> None:
        self._links, self._stopped = links, stopped
        self._missed: list[int] = []  # both ends of each connection that nodes have lost
        # node that answered the last PING → nodes whose frames it awaits
        self._answered: dict[int, list[int]] = {}
        self._pings = 0

    def report_missed(self, number: int, peer: int) -> None:
        """Note that a node has lost its connection to another one. Raises LinkLostError."""
        self._missed += (number, peer)
        raise LinkLostError(peer)

    def receive_pong(self, number: int, frame: NodeFrame) -> None:
        """Apply the answer of a node to a PING."""
        if frame.number == self._pings:
            awaited = read_list(frame)
            check_indices("node", (peer for peer in awaited if peer != COORDINATOR), MOST_NODES)
            self._answered[number] = awaited

    def wait(
        self,
        living: Sequence[int],
        timeout_s: float,
        wait: Callable[[float], Found],  # waits up to a number of seconds; may be called again
    ) -> Found:
        """Call `wait` until it succeeds, as long as all nodes answer meanwhile.

        Raises:
            SilentNodeError: a node does not answer, or its process is stopped, or another node
                waits for it in vain, or it owes another node an answer after two timeouts.
            WorkerError: all nodes answer, but `wait` does not succeed.
        """
        silence: SilenceError | None = None
        for _ in range(VAIN):
            try:
                return self._wait(timeout_s, wait)
            except SilenceError as error:
                before, silence = silence, error
                self._ask(living)
                for number in sorted(set(before.awaited if before else ()) & set(error.awaited)):
                    raise SilentNodeError(
                        number, MessageError("it does not answer offers")
                    ) from error
        raise WorkerError(
            f"{silence}, {VAIN} times, although all nodes are alive; raise workers.timeout_s = "
            f"{timeout_s:g}"
        ) from silence

    def _wait(self, timeout_s: float, wait: Callable[[float], Found]) -> Found:
        """Wait, and check from time to time whether a process is stopped."""
        stopped: set[int] = set()
        left_s = timeout_s
        while left_s > LOOK_S:
            try:
                return wait(LOOK_S)
            except SilenceError:
                left_s -= LOOK_S
                before, stopped = stopped, self._stopped()
                for number in sorted(before & stopped):
                    raise SilentNodeError(number, MessageError("its process is stopped")) from None
        try:
            return wait(left_s)
        except SilenceError as silence:
            text = f"no frame has come for {timeout_s:g} s"
            raise SilenceError(text, silence.awaited) from silence

    def _ask(self, living: Sequence[int]) -> None:
        """Send a PING to all nodes, and evaluate the answers.

        Raises:
            SilentNodeError: a node does not answer, or others wait for it.
        """
        links = self._links
        self._pings += 1
        self._answered.clear()
        for number in living:
            links.send(number, FrameKind.PING, self._pings)
        until_s = links.now_s() + PONG_S
        while len(self._answered) < len(living) and (left_s := until_s - links.now_s()) > 0:
            links.pump(1e3 * left_s)
        for number in living:
            if number not in self._answered:
                raise SilentNodeError(number, MessageError("it does not answer"))
        awaited = Counter(peer for peers in self._answered.values() for peer in peers)
        for number, _ in awaited.most_common():
            if number in living:
                raise SilentNodeError(number, MessageError("others wait for it"))

    def most_missed(self, lost: LinkLostError) -> LinkLostError:
        """Return the node that has ended, or else the node that most nodes cannot reach."""
        links = self._links
        if not self._missed:  # the node has sent a bad frame
            return lost
        until_s = links.now_s() + MISSED_S
        while lost.peer in links.numbers and (left_s := until_s - links.now_s()) > 0:
            try:
                links.pump(1e3 * left_s)
            except LinkLostError as more:
                lost = more
        if lost.peer not in links.numbers:
            return lost
        worst = max(self._missed, key=lambda number: (self._missed.count(number), number))
        return LinkLostError(worst, MessageError("other nodes do not reach it"))

    def forget_missed(self) -> None:
        """Drop reports of lost connections after a node was given up."""
        self._missed.clear()
