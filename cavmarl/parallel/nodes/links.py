"""`Links`: the connections of a process to other processes, which carry whole frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import NamedTuple, TypeAlias

from cavmarl.core.errors import MessageError
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.parallel.network.link_quality import LinkQuality, measure_link
from cavmarl.parallel.network.transport import READS, READS_AND_WRITES, Bytes, Connection
from cavmarl.parallel.nodes.link import FrameKind, Link, NodeFrame
from cavmarl.parallel.nodes.node_system import MACHINE, NodeSystem
from cavmarl.parallel.nodes.peer_faults import LinkLostError, reading

LOST = (EOFError, OSError, MessageError)  # errors that end a connection

Urgent: TypeAlias = Callable[[int, NodeFrame], Exception | None]
"""Handles an urgent frame as soon as it has arrived; the first argument is its sender.

An error in the handler is the fault of the sender. `pump` raises an error that the
handler returns."""


class AwaitedOffer(NamedTuple):
    """An unanswered offer of a vehicle."""

    world: int
    vehicle: int
    zone: int  # zone that has to answer
    source: int  # node that has to offer the vehicle
    target: int  # node of the zone


class SilenceError(Exception):
    """An awaited frame has not arrived in time.

    Attributes:
        offers: offers whose answers are awaited.
    """

    def __init__(self, text: str, offers: Collection[AwaitedOffer] = ()) -> None:
        super().__init__(text)
        self.offers = frozenset(offers)


class RecoveryOrderedError(Exception):
    """A node has to go back to a kept state.

    Attributes:
        frame: the order, if it has been received.
        witness: node that claims to have received the order.
    """

    def __init__(self, frame: NodeFrame | None, witness: int | None = None) -> None:
        super().__init__("other nodes are lost")
        self.frame, self.witness = frame, witness


class Links:
    """Connections, by the number of the process at the other end."""

    def __init__(self, urgent: Urgent, system: NodeSystem = MACHINE) -> None:
        self.urgent = urgent
        self.now_s = system.now_s
        self._looks = system.looks
        self._links: dict[int, Link] = {}
        self._poll = system.poll()
        self._by_place: dict[int, tuple[int, Link]] = {}  # `fileno` → number and link
        self._urgent_frames: deque[tuple[int, NodeFrame]] = (
            deque()
        )  # urgent frames, and their senders
        self.wanted: Collection[int] = ()  # senders whose frames this process awaits
        self.waited_s = 0.0
        self.sent_bytes = 0
        self.sent_frames = 0

    def add(self, number: int, connection: Connection | Link) -> None:
        link = connection if isinstance(connection, Link) else Link(connection)
        self._links[number] = link
        self._by_place[link.connection.fileno()] = number, link
        self._poll.register(link.connection, READS)

    @property
    def numbers(self) -> tuple[int, ...]:
        return tuple(self._links)

    def qualities(self) -> list[tuple[int, LinkQuality]]:
        """Return what the system has measured about each connection."""
        return [(number, measure_link(link.connection)) for number, link in self._links.items()]

    @property
    def awaited(self) -> list[int]:
        """Nodes whose frames this process awaits and has not received."""
        links = self._links
        return sorted(n for n in self.wanted if n not in links or not links[n].frames)

    def send(self, to: int, kind: FrameKind, number: int, pieces: Sequence[Bytes] = ()) -> None:
        """Send a frame.

        Raises:
            LinkLostError: the other end has disconnected.
        """
        try:
            link = self._links[to]
            self.sent_bytes += link.send(kind, number, pieces)
        except KeyError:
            raise LinkLostError(to) from None
        except OSError as error:
            raise self._lost(to, error) from error
        self.sent_frames += 1
        if link.waiting:
            self._poll.modify(link.connection, READS_AND_WRITES)

    def receive(
        self,
        wanted: Collection[int],  # numbers of the senders
        timeout_s: float | None = None,  # None: no limit
    ) -> dict[int, NodeFrame]:
        """Receive the next frame of each sender.

        Raises:
            LinkLostError: a sender has disconnected.
            SilenceError: a frame has not arrived in time.
            RecoveryOrderedError: the coordinator has ordered a recovery.
        """
        links, is_member = self._links, COORDINATOR not in wanted
        self.wanted = wanted
        until_s = None if timeout_s is None else self.now_s() + timeout_s
        left_ms = None
        for number in wanted:
            while number not in links or not links[number].frames:
                if is_member:
                    self.check_recovery()
                if number not in links:
                    raise LinkLostError(number)
                if until_s is not None:
                    left_ms = 1e3 * (until_s - self.now_s())
                    if left_ms <= 0.0:
                        silent = self.awaited
                        raise SilenceError(f"nodes {silent} do not answer within {timeout_s:g} s")
                self.pump(left_ms)
        if is_member:
            self.check_recovery()
        found = {}
        for number in wanted:
            found[number] = links[number].frames.popleft()
        self.wanted = ()
        return found

    def receive_next(self, number: int) -> NodeFrame:
        """Receive a sender's next frame, without a limit. Raises the errors of `receive`."""
        try:
            frames = self._links[number].frames
        except KeyError:
            raise LinkLostError(number) from None
        if not frames:
            self.wanted = (number,)
            # Another node is at the same point of its tick, so polling is faster than sleeping.
            looks = 0 if number == COORDINATOR else self._looks
            while not frames:
                if number != COORDINATOR:
                    self.check_recovery()
                self.pump(None, looks)
            self.wanted = ()
        return frames.popleft()

    def check_recovery(self) -> None:
        """Raise RecoveryOrderedError if the coordinator has ordered a recovery.

        During a recovery, an awaited frame may never arrive, since its sender may be lost.
        """
        link = self._links.get(COORDINATOR)
        if link is None or not link.frames:
            return
        if any(frame.kind is FrameKind.RECOVER for frame in link.frames):
            raise RecoveryOrderedError(None)

    def receive_if_there(self, number: int) -> NodeFrame | None:
        """Return the next frame of a sender, if it has arrived."""
        frames = self._links[number].frames
        return frames.popleft() if frames else None

    def await_urgent(self, number: int, has_come: Callable[[], bool]) -> None:
        """Wait for an urgent frame that a sender has to send before its next non-urgent frame.

        Args:
            number: number of the sender, another node.
            has_come: returns whether the urgent frame has arrived and was handled.

        Raises:
            LinkLostError: the sender has disconnected, or has not sent the frame.
            RecoveryOrderedError: the coordinator has ordered a recovery.
        """
        self.wanted = (number,)
        while not has_come():
            self.check_recovery()
            link = self._links.get(number)
            if link is None:
                raise LinkLostError(number)
            if link.frames and link.frames[0].kind is FrameKind.SYNC:
                raise RecoveryOrderedError(None, number)
            if link.frames:
                error = MessageError(f"it sends {link.frames[0].kind.name} before an awaited frame")
                raise LinkLostError(number, error)
            self.pump(None)
        self.wanted = ()

    def has(self, number: int) -> bool:
        """Return whether a frame of a sender waits here."""
        return number in self._links and bool(self._links[number].frames)

    def release(self, number: int) -> Link:
        """Remove a connection and return it."""
        return self._forget(number)

    def unread(self, number: int, frame: NodeFrame) -> None:
        """Put a frame back, as the next frame of its sender."""
        self._links[number].frames.appendleft(frame)

    def pump(self, timeout_ms: float | None, looks: int = 0) -> None:
        """Send and receive on ready connections; wait up to `timeout_ms` for a ready connection.

        Poll `looks` times before the process sleeps.
        """
        if self._urgent_frames:  # frames left after an earlier urgent frame raised an error
            self._deliver()
            return
        began_s = self.now_s()
        poll = self._poll.poll
        for _ in range(looks):
            if ready := poll(0):
                break
        else:
            ready = poll(timeout_ms)
        self.waited_s += self.now_s() - began_s
        for place, _ in ready:
            number, link = self._by_place[place]
            try:
                if link.waiting:
                    link.go_on_sending()
                    if not link.waiting:
                        self._poll.modify(link.connection, READS)
                link.receive(self._urgent_frames, number)
            except LOST as error:
                self._deliver()
                raise self._lost(number, error) from error
            if self._urgent_frames:
                self._deliver()

    def _deliver(self) -> None:
        """Pass urgent frames to the handler."""
        while self._urgent_frames:
            number, frame = self._urgent_frames.popleft()
            try:
                with reading(number):
                    error = self.urgent(number, frame)
            except LinkLostError as lost:
                if lost.peer == number:
                    self.drop(number)
                raise
            if error is not None:
                raise error

    def _lost(self, number: int, error: Exception) -> LinkLostError:
        self.drop(number)
        return LinkLostError(number, error)

    def flush(self) -> None:
        """Wait until all frames are sent."""
        while any(link.waiting for link in self._links.values()):
            self.pump(None)

    def drop(self, number: int) -> None:
        """Close a connection, if there is one."""
        if number in self._links:
            self._forget(number).connection.close()

    def _forget(self, number: int) -> Link:
        link = self._links.pop(number)
        self._poll.unregister(link.connection)
        del self._by_place[link.connection.fileno()]
        return link

    def end(self, timeout_s: float) -> None:
        """Send END on all connections, and wait up to `timeout_s` for the other ends to close."""
        for number in self.numbers:
            with suppress(LinkLostError):
                self.send(number, FrameKind.END, 0)
        self.urgent = _ignore
        until_s = self.now_s() + timeout_s
        while self._links and self.now_s() < until_s:
            with suppress(LinkLostError):
                self.pump(1e3 * max(until_s - self.now_s(), 0.0))
        self.close()

    def close(self) -> None:
        for number in self.numbers:
            self.drop(number)


def _ignore(number: int, frame: NodeFrame) -> Exception | None:
    """Ignore a late frame."""
    return None
