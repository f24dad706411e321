"""`NodeWatch`: finds the lost node if a node is silent or other nodes cannot reach it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

from cavmarl.core.errors import MessageError, WorkerError
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame, read_list
from cavmarl.parallel.nodes.links import AwaitedOffer, Links, SilenceError
from cavmarl.parallel.nodes.peer_faults import LinkLostError, check_indices

LOOK_S = 0.5  # time between checks; a process that is stopped at two checks counts as lost
PONG_S = 1.0  # time for a live node to answer a PING
MISSED_S = 0.1  # time to collect reports of lost connections
VAIN = 5  # number of PINGs that all nodes answer before an unfinished command fails

MOST_NODES = 1 << 32

Found = TypeVar("Found")


class Pong(NamedTuple):
    """The answer of a node to a PING."""

    awaited: list[int]  # nodes whose frames this node awaits, or COORDINATOR
    witnesses: list[int]  # node that claims a recovery was ordered, if this node awaits the order
    answered: Sequence[Sequence[int]]  # world, vehicle and zone of each offer this node answered
    agents: list[int]  # agents whose actions this node awaits


class SilentNodeError(LinkLostError):
    """A node is silent, or keeps another node waiting; its process may still run."""


class NodeWatch:
    """Watches the nodes at the other ends of `links`."""

    def __init__(
        self,
        links: Links,
        stopped: Callable[[], set[int]],  # returns the nodes whose processes are stopped
        # agent → node that has received its action, or has refused it; raises IndexError
        holder: Callable[[int], int],
    ) -> None:
        self._links, self._stopped, self._holder = links, stopped, holder
        self._missed: list[int] = []  # both ends of each connection that nodes have lost
        # node → nodes that have received a bad frame from it, and the fault of the frame
        self._faults: dict[int, dict[int, str]] = {}
        self._answered: dict[int, Pong] = {}  # node → its answer to the last PING
        self._pings = 0

    def report_missed(self, number: int, peer: int, fault: str) -> None:
        """Note that a node has lost its connection to another node. Raises LinkLostError.

        Args:
            number: number of the node.
            peer: number of the other node.
            fault: reason why a frame of the other node is bad; empty if the connection has ended.
        """
        self._missed += (number, peer)
        if fault:
            self._faults.setdefault(peer, {})[number] = fault
        raise LinkLostError(peer)

    def receive_pong(self, number: int, frame: NodeFrame) -> None:
        """Apply the answer of a node to a PING. Raises the errors of `reading`."""
        check_indices("PING", [frame.number], self._pings + 1)
        pong = Pong(*read_list(frame))
        if not all(isinstance(part, list) for part in pong):
            raise MessageError("a PONG has values other than lists")
        peers = [peer for peer in (*pong.awaited, *pong.witnesses) if peer != COORDINATOR]
        check_indices("node", peers, MOST_NODES)
        for agent in pong.agents:
            self._holder(agent)
        if frame.number == self._pings:
            self._answered[number] = pong

    def wait(
        self,
        living: Sequence[int],
        timeout_s: float,
        wait: Callable[[float], Found],  # waits up to a number of seconds; may be called again
    ) -> Found:
        """Call `wait` until it succeeds, as long as all nodes answer.

        Raises:
            SilentNodeError: a node does not answer; its process is stopped; another process awaits
                its frame; or its offer or its answer to an offer is missing after two timeouts.
            WorkerError: all nodes answer, but `wait` does not succeed.
        """
        silence: SilenceError | None = None
        for _ in range(VAIN):
            try:
                return self._wait(timeout_s, wait)
            except SilenceError as error:
                before, silence = silence, error
                self._ask(living)
                for offer in sorted(error.offers & before.offers if before else ()):
                    raise self._without_answer(offer) from error
        raise WorkerError(
            f"{silence}; this happened {VAIN} times in a row, although all nodes are alive; "
            f"raise workers.timeout_s = {timeout_s:g}"
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
            text = f"no frame has arrived for {timeout_s:g} s"
            raise SilenceError(text, silence.offers) from silence

    def _without_answer(self, offer: AwaitedOffer) -> SilentNodeError:
        """Return an error with the node that is at fault for an unanswered offer."""
        if [offer.world, offer.vehicle, offer.zone] in self._answered[offer.target].answered:
            return SilentNodeError(offer.target, MessageError("its answer to an offer is missing"))
        why = f"it has not offered vehicle {offer.vehicle}, which it reports as offered"
        return SilentNodeError(offer.source, MessageError(why))

    def _ask(self, living: Sequence[int]) -> None:
        """Send a PING to all nodes, and evaluate the answers.

        Raises:
            SilentNodeError: a node does not answer, or other nodes wait for it.
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
        witnesses = (number for pong in self._answered.values() for number in pong.witnesses)
        for number in witnesses:  # an order would have arrived before the PING
            if number in living:
                raise SilentNodeError(number, MessageError("it claims that a recovery was ordered"))
        for pong in self._answered.values():
            for number in {self._holder(agent) for agent in pong.agents} & {*living}:
                raise SilentNodeError(number, MessageError("it has not refused foreign actions"))
        awaited = Counter(peer for pong in self._answered.values() for peer in pong.awaited)
        for number in sorted(living, key=lambda n: (self._waits(n, living), -awaited[n])):
            if awaited[number]:
                raise SilentNodeError(number, MessageError("other nodes wait for it"))
        for number in links.awaited:  # a frame would have arrived before the answer to the PING
            if number in living and COORDINATOR in self._answered[number].awaited:
                raise SilentNodeError(number, MessageError("its frame is missing"))

    def _waits(self, number: int, living: Sequence[int]) -> bool:
        """Return whether a node waits for another node."""
        return not {*living}.isdisjoint(self._answered[number].awaited)

    def most_missed(self, lost: LinkLostError, generation: int) -> LinkLostError:
        """Return the node that is lost, after nodes have reported lost connections.

        If a node has ended, it is the lost node. Otherwise, if there were bad frames, the node that
        has sent bad frames to the most nodes is lost. Otherwise, the node that the most nodes
        cannot reach is lost. If two nodes cannot reach each other, either may be at fault. So the
        node that counts as lost alternates with `generation`.

        Args:
            lost: the first report.
            generation: number of changes of nodes.
        """
        links = self._links
        if not self._missed:  # no reports: the caller itself has noticed the loss
            return lost
        until_s = links.now_s() + MISSED_S
        while lost.peer in links.numbers and (left_s := until_s - links.now_s()) > 0:
            try:
                links.pump(1e3 * left_s)
            except LinkLostError as more:
                lost = more
        if lost.peer not in links.numbers:
            return lost
        sign = -1 if generation % 2 else 1
        if self._faults:
            worst = max(self._faults, key=lambda n: (len(self._faults[n]), sign * n))
            witness, fault = next(iter(self._faults[worst].items()))
            return LinkLostError(worst, MessageError(f"node {witness} reports: {fault}"))
        worst = max(self._missed, key=lambda n: (self._missed.count(n), sign * n))
        return LinkLostError(worst, MessageError("other nodes do not reach it"))

    def forget_missed(self) -> None:
        """Drop reports of lost connections after a node was declared lost."""
        self._missed.clear()
        self._faults.clear()
