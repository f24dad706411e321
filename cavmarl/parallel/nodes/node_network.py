"""A network simulator of the caller, which decides which packets the stations of nodes receive.

All nodes compute the same packets. In each tick, the reporter (the node that reports common
results) sends a request to the caller, which asks the simulator and sends the answer to all nodes.
The caller keeps the answers of a command: if nodes go back and repeat a step, it sends them again
and does not ask the simulator.
"""

from __future__ import annotations

import struct
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, MessageError
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.parallel.network.transport import Bytes
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame
from cavmarl.parallel.nodes.links import Links
from cavmarl.parallel.nodes.peer_faults import reading
from cavmarl.v2x.bus import Bus
from cavmarl.v2x.kernels.v2x_records import PACKET, RECEIVER
from cavmarl.v2x.v2x_messages import RECEPTION, Exchange, NetworkSimulator, check_receptions

_HEAD = struct.Struct("<QQQQ")


class NetworkFailedError(Exception):
    """The simulator has failed, or has given a bad answer; no node is at fault.

    Attributes:
        error: the error for the caller of the step.
    """

    def __init__(self, error: Exception) -> None:
        super().__init__(str(error))
        self.error = error


class RemoteNetwork:
    """The network simulator of the caller, as a `NetworkSimulator` for the bus of a node."""

    def __init__(self, links: Links, bus: Bus) -> None:
        self._links, self._bus = links, bus
        self._generation = 0
        self._is_reporter, self._reporter = False, COORDINATOR
        self._answers: deque[NodeFrame] = deque()
        bus.connect(self)

    def begin(self, generation: int, number: int, reporter: int) -> None:
        """Start a new generation of nodes, with the numbers of this node and of the reporter."""
        self._generation, self._is_reporter = generation, number == reporter
        self._reporter = COORDINATOR if self._is_reporter else reporter

    def receive(self, frame: NodeFrame) -> None:
        self._answers.append(frame)

    def exchange(self, sent: Exchange) -> NDArray[np.void]:
        """See `NetworkSimulator.exchange`.

        Raises:
            RecoveryOrderedError: the coordinator has ordered a recovery.
        """
        links = self._links
        if self._is_reporter:
            asked = request_of(sent, self._bus.mail.num_packets[sent.world])
            links.send(COORDINATOR, FrameKind.EXCHANGE, self._generation, asked)
        links.wanted = (self._reporter,)
        while True:
            while self._answers:
                frame = self._answers.popleft()
                if frame.number == self._generation:
                    with reading(COORDINATOR):
                        links.wanted = ()
                        found = np.frombuffer(frame.data, RECEPTION)
                        latency = len(self._bus.mail.num_packets[sent.world]) - 1
                        return check_receptions(
                            found, sent, latency, self._bus.mail.num_packets[sent.world]
                        )
            links.check_recovery()
            links.pump(None)


class ExchangeRequest(NamedTuple):
    """A request to the simulator, and the data needed to check the answer."""

    exchange: Exchange
    num_packets: NDArray[np.int64]  # number of packets in flight, see `check_receptions`


def request_of(sent: Exchange, num_packets: NDArray[np.int64]) -> list[Bytes]:
    """Return a request as pieces of a frame."""
    arrays = (num_packets, sent.packets, sent.receivers)
    head = _HEAD.pack(sent.world, sent.tick, len(sent.packets), len(sent.receivers))
    return [head, *(np.ascontiguousarray(array).tobytes() for array in arrays)]


def read_request(data: memoryview, num_worlds: int, latency_ticks: int) -> ExchangeRequest:
    """Read a request. Raises MessageError: the bytes are not a request."""
    slots, at = latency_ticks + 1, _HEAD.size + 8 * (latency_ticks + 1)
    if len(data) < at:
        raise MessageError(f"{len(data)} bytes are too short for an exchange")
    world, tick, packets, receivers = _HEAD.unpack_from(data)
    size = at + packets * PACKET.itemsize + receivers * RECEIVER.itemsize
    if world >= num_worlds or len(data) != size:
        raise MessageError(f"{len(data)} bytes are not an exchange of world {world}")
    sent = Exchange(
        world,
        tick,
        np.frombuffer(data, PACKET, packets, at),
        np.frombuffer(data, RECEIVER, receivers, at + packets * PACKET.itemsize),
    )
    return ExchangeRequest(sent, np.frombuffer(data, np.int64, slots, _HEAD.size))


def answer_of(network: NetworkSimulator | None, asked: ExchangeRequest) -> bytes:
    """Return the answer of the simulator.

    Raises:
        NetworkFailedError: there is no simulator, or it fails, or gives a bad answer.
    """
    sent = asked.exchange
    try:
        if network is None:
            raise ConfigError(
                "v2x.channel.external: connect a network simulator before the first step "
                "(worlds.connect_network)"
            )
        latency = len(asked.num_packets) - 1
        return check_receptions(network.exchange(sent), sent, latency, asked.num_packets).tobytes()
    except Exception as error:
        raise NetworkFailedError(error) from error
