"""How nodes find each other: each proves that it knows the secret."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from cavmarl.core.errors import MessageError
from cavmarl.parallel.network.transport import READS, Connection, Place, TransportListener
from cavmarl.parallel.nodes.node_system import NodeSystem
from cavmarl.parallel.nodes.peer_faults import LinkLostError

LOOK_MS = 50.0  # so often it is looked whether those that are awaited still live
ANSWER_S = 5.0  # for a node to answer a call
_MOST = 1 << 16  # nodes, and generations that are told apart


def caller_number(number: int, generation: int) -> int:
    """What a node says when it calls another one: which it is, and for which attempt to begin."""
    return number + generation % _MOST * _MOST


def accept_nodes(
    system: NodeSystem,
    listener: TransportListener,
    wanted: Iterable[int],  # numbers of those that are to call
    generation: int,  # how often nodes have come and gone; calls of other times count no more
    timeout_s: float,
    check: Callable[[], None],  # raises if one will never call
) -> dict[int, Connection]:
    """The connections of all that are awaited; other callers are turned away.

    Raises:
        LinkLostError: one has not called in time.
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
            for said, connection in listener.admit():
                if said in missing:
                    found[missing.pop(said)] = connection
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
    """A connection to node `of` of node `number`.

    Raises:
        LinkLostError: it cannot be reached.
    """
    try:
        return system.open(place, secret, caller_number(number, generation), ANSWER_S)
    except (OSError, EOFError, MessageError) as error:
        raise LinkLostError(of) from error
