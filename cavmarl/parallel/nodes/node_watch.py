"""`NodeWatch`: finds out which node is lost, when one is silent or others cannot reach it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import TypeVar

from cavmarl.core.errors import MessageError, WorkerError
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame, read_list
from cavmarl.parallel.nodes.links import Links, SilenceError
from cavmarl.parallel.nodes.peer_faults import LinkLostError, check_indices

LOOK_S = 0.5  # between looks; a process that is stopped at two of them is given up
PONG_S = 1.0  # for a living node to answer
MISSED_S = 0.1  # to hear which others miss a node
VAIN = 5  # times that all nodes answer and yet nothing comes of a command

MOST_NODES = 1 << 32

Found = TypeVar("Found")


class SilentNodeError(LinkLostError):
    """A node says nothing, or another one waits for it in vain; its process may still run."""


class NodeWatch:
    """Of the nodes at the other ends of some connections."""

    def __init__(
        self,
        links: Links,
        stopped: Callable[[], set[int]],  # nodes whose processes are known to be stopped
    ) -> None:
        self._links, self._stopped = links, stopped
        self._missed: list[int] = []  # the two ends of connections that nodes have lost
        # nodes that answered the last PING, and whose frames each waits for
        self._answered: dict[int, list[int]] = {}
        self._pings = 0

    def report_missed(self, number: int, peer: int) -> None:
        """A node says that its connection to another one has ended. Raises LinkLostError."""
        self._missed += (number, peer)
        raise LinkLostError(peer)

    def receive_pong(self, number: int, frame: NodeFrame) -> None:
        if frame.number == self._pings:
            awaited = read_list(frame)
            check_indices("node", (peer for peer in awaited if peer != COORDINATOR), MOST_NODES)
            self._answered[number] = awaited

    def wait(
        self,
        living: Sequence[int],
        timeout_s: float,
        wait: Callable[[float], Found],  # for so many seconds; may be called again after silence
    ) -> Found:
        """What comes of waiting, again and again as long as all nodes answer meanwhile.

        Raises:
            SilentNodeError: one does not, its process is stopped, another one waits for it in
                vain, or it has not answered another one in two silences.
            WorkerError: all answer, and nothing comes of it.
        """
        silence: SilenceError | None = None
        for _ in range(VAIN):
            try:
                return self._wait(timeout_s, wait)
            except SilenceError as error:
                before, silence = silence, error
                self._ask(living)
                for number in sorted(set(before.awaited if before else ()) & set(error.awaited)):
                    raise SilentNodeError(number, MessageError("it answers no offers")) from error
        raise WorkerError(f"{silence}, {VAIN} times, though all nodes live") from silence

    def _wait(self, timeout_s: float, wait: Callable[[float], Found]) -> Found:
        """Wait, and look now and then whether a process is stopped."""
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
            text = f"nothing has come for {timeout_s:g} s"
            raise SilenceError(text, silence.awaited) from silence

    def _ask(self, living: Sequence[int]) -> None:
        """Ask all nodes whether they live, and which nodes they wait for."""
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
                raise SilentNodeError(number, MessageError("it says nothing"))
        awaited = Counter(peer for peers in self._answered.values() for peer in peers)
        for number, _ in awaited.most_common():
            if number in living:
                raise SilentNodeError(number, MessageError("others wait for it"))

    def most_missed(self, lost: LinkLostError) -> LinkLostError:
        """The node that has ended, or else the one that cannot be reached by most others."""
        links = self._links
        if not self._missed:  # what it sent cannot be
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
        """A node is given up: what was missed because of it does not count any more."""
        self._missed.clear()
