"""How nodes find each other: each proves that it knows the secret."""

from __future__ import annotations

import select
import socket
from collections.abc import Callable, Iterable

from cavmarl.core.errors import MessageError, WorkerError
from cavmarl.parallel.nodes.links import LinkLostError
from cavmarl.parallel.nodes.node_system import NodeListener, NodeSystem, Place

LOOK_MS = 50.0  # so often it is looked whether those that are awaited still live
ANSWER_S = 5.0  # for a node to answer a call


def calls_of(
    system: NodeSystem,
    listener: NodeListener,
    wanted: Iterable[int],  # numbers of those that are to call
    timeout_s: float,
    check: Callable[[], None],  # raises if one will never call
) -> dict[int, socket.socket]:
    """The connections of all that are awaited; other callers are turned away.

    Raises:
        WorkerError: one has not called in time.
    """
    missing, found = set(wanted), dict[int, socket.socket]()
    until_s = system.now_s() + timeout_s
    poll = system.poll()
    poll.register(listener, select.POLLIN)
    try:
        while missing:
            check()
            if system.now_s() > until_s:
                raise WorkerError(f"nodes {sorted(missing)} have not called within {timeout_s:g} s")
            poll.poll(LOOK_MS)
            for number, connection in listener.admit():
                if number in missing:
                    found[number] = connection
                    missing.remove(number)
                else:
                    connection.close()
    except BaseException:
        for connection in found.values():
            connection.close()
        raise
    return found


def call_node(
    system: NodeSystem, place: Place, secret: bytes, number: int, of: int
) -> socket.socket:
    """A connection to node `of` of node `number`.

    Raises:
        LinkLostError: it cannot be reached.
    """
    try:
        return system.call(place, secret, number, ANSWER_S)
    except (OSError, EOFError, MessageError) as error:
        raise LinkLostError(of) from error
