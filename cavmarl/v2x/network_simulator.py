"""`NetworkSimulator`: what stands in for the channel, and how it is asked.

A simulator of the network (ns-3, OMNeT++ or any other) that runs beside the world implements
`exchange`. It is called once a tick and world, with what is sent in that tick, and returns when it
has simulated up to that tick: the call is the barrier of a step. Neither side runs ahead.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MessageError

# One receiver receives one packet in the tick of the call.
RECEPTION = np.dtype(
    [
        ("tick", np.int64),  # in which the packet was sent
        ("packet", np.int64),  # its number among the packets of that tick
        ("receiver", np.int64),  # row of `Exchange.receivers`
    ],
    align=True,
)


class Exchange(NamedTuple):
    """What a network simulator is told of one tick of one world; views, not to be kept."""

    world: int
    tick: int  # of that world; it begins at 1 after a reset
    packets: NDArray[np.void]  # PACKET (n,) that are sent now, by sender, then kind
    # RECEIVER (R,), where the agents and the roadside units are; id -1: none
    receivers: NDArray[np.void]


class NetworkSimulator(Protocol):
    """Decides which stations receive which packets in which tick."""

    def exchange(self, sent: Exchange) -> NDArray[np.void]:
        """Simulate up to this tick.

        A tick that is begun again, because a host has died, is asked for again with the same
        packets, and must be answered alike.

        Returns:
            RECEPTION (n,): what is received now, of this tick's packets or of earlier ones.
        """
        ...


def check_receptions(
    receptions: NDArray[np.void],
    sent: Exchange,
    latency_ticks: int,
    num_packets: NDArray[np.int64],
) -> NDArray[np.void]:
    """Refuse receptions that cannot be.

    `receptions`: the answer to `sent`. `latency_ticks`: the longest delay. `num_packets`:
    (latency_ticks + 1,) packets in flight, by tick modulo that.

    Returns:
        them by receiver, tick and packet, so that the order of the answer does not matter.

    Raises:
        MessageError: another dtype, packets or receivers that are not there, or a delay that is too
            long or negative.
    """
    if not isinstance(receptions, np.ndarray) or receptions.dtype != RECEPTION:
        raise MessageError("a network simulator answers with an array of dtype RECEPTION")
    delay = sent.tick - receptions["tick"]
    if ((delay < 0) | (delay > latency_ticks) | (receptions["tick"] < 1)).any():
        raise MessageError(
            f"tick {sent.tick}: a reception of another tick than those from "
            f"{max(1, sent.tick - latency_ticks)} to {sent.tick}; v2x.channel.latency_ticks is the "
            "longest delay"
        )
    number, count = receptions["packet"], num_packets[receptions["tick"] % (latency_ticks + 1)]
    if ((number < 0) | (number >= count)).any():
        raise MessageError(f"tick {sent.tick}: a reception of a packet that was not sent")
    receiver = receptions["receiver"]
    if ((receiver < 0) | (receiver >= len(sent.receivers))).any():
        raise MessageError(f"tick {sent.tick}: a reception by no station")
    there = sent.receivers["id"][receiver] >= 0
    return np.sort(receptions[there], order=("receiver", "tick", "packet"))
