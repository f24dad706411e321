"""How nodes and their coordinator find each other: each proves that it knows the secret."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Iterable

from cavmarl.core.errors import MessageError, WorkerError
from cavmarl.parallel.hosts.listener import MAX_GUESTS, Listener, PendingConnection

LOOK_MS = 200.0  # so often it is looked whether those that are awaited still live


def calls_of(
    listener: Listener,
    wanted: Iterable[int],  # numbers of those that are to call
    timeout_s: float,
    check: Callable[[], None] = lambda: None,  # raises if one will never call
) -> dict[int, socket.socket]:
    """The connections of all that are awaited; other callers are turned away.

    Raises:
        WorkerError: one has not called in time.
    """
    missing, found = set(wanted), dict[int, socket.socket]()
    guests: dict[int, PendingConnection] = {}
    until_s = time.monotonic() + timeout_s
    poll = select.poll()
    poll.register(listener, select.POLLIN)
    while missing:
        check()
        if time.monotonic() > until_s:
            raise WorkerError(f"nodes {sorted(missing)} have not called within {timeout_s:g} s")
        for ready, _ in poll.poll(LOOK_MS):
            if ready == listener.fileno():
                guest = listener.open()
                if guest is not None and len(guests) < MAX_GUESTS:
                    guests[guest.fileno()] = guest
                    poll.register(guest, select.POLLIN)
                elif guest is not None:
                    guest.close()
                continue
            guest = guests[ready]
            try:
                connection = guest.listen()
                if connection is None:
                    continue
                if guest.number not in missing:
                    raise MessageError(f"node {guest.number} is not awaited")
                found[guest.number] = connection
                missing.remove(guest.number)
            except (MessageError, EOFError, OSError):
                guest.close()
            poll.unregister(ready)
            del guests[ready]
    for guest in guests.values():
        guest.close()
    return found
