"""Connections between nodes; both ends prove that they know the secret."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from cavmarl.core.errors import MessageError
from cavmarl.parallel.network.transport import READS, Connection, Place, TransportListener
from cavmarl.parallel.nodes.node_system import NodeSystem
from cavmarl.parallel.nodes.peer_faults import LinkLostError

LOOK_MS = 50.0  # time between checks that the awaited nodes are still alive
ANSWER_S = 5.0  # time for a node to answer a call
_MOST = 1 << 16  # limit of node numbers; generations are sent modulo this limit


def caller_number(number: int, generation: int) -> int:
    """Return the number that a node sends with a call: its own number and the generation."""
    return number + generation % _MOST * _MOST


def accept_nodes(
    system: NodeSystem,
    listener: TransportListener,
    wanted: Iterable[int],  # numbers of the nodes that will call
    generation: int,  # number of changes of nodes; calls of other generations are rejected
    timeout_s: float,
    check: Callable[[], None],  # raises if a node will never call
) -> dict[int, Connection]:
    """Accept the calls of all wanted nodes, and reject other callers.

    Raises:
        LinkLostError: a node has not called in time.
    """
    missing = {caller_number(number, generation): number for number in wanted}
    found: dict[int, Connection] = {}
    until_s = system.now_s() + timeout_s
    poll = system.poll()
    poll.register(listener, READS)
    try:
        while missing:
            check()
            if system.now_s() > until_s:
                raise LinkLostError(min(missing.values()))
            poll.poll(LOOK_MS)
            for caller, connection in listener.admit():
                if caller in missing:
                    found[missing.pop(caller)] = connection
                else:
                    connection.close()
    except BaseException:
        for connection in found.values():
            connection.close()
        raise
    return found


def call_node(
    system: NodeSystem, place: Place, secret: bytes, number: int, generation: int, of: int
) -> Connection:
    """Call node `of` as node `number`, and return the connection.

    Raises:
        LinkLostError: the node cannot be reached.
    """
    try:
        return system.open(place, secret, caller_number(number, generation), ANSWER_S)
    # A node has reported `place`, so it may have any value.
    except (OSError, EOFError, MessageError, ValueError) as error:
        raise LinkLostError(of) from error
