"""`FaultyNetwork`: a proxy for connections that injects network faults."""

from __future__ import annotations

import random
import select
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from enum import StrEnum
from functools import partial
from typing import TypeAlias

LOCAL = "127.0.0.1"
CHUNK = 1 << 16
LONGEST_DELAY_S = 0.05
END_S = 2.0  # time for a thread to end

Place: TypeAlias = tuple[str, int]


class NetworkFault(StrEnum):
    """A fault in one direction of a connection."""

    DELAY = "delay"  # the next bytes arrive late
    DAMAGE = "damage"  # one bit of the next bytes flips
    CUT = "cut"  # the connection ends, possibly within a frame
    SILENCE = "silence"  # no further bytes arrive, without notice


class _Connection:
    """The two sockets of one connection. Direction 0 is from the caller, 1 is to the caller."""

    def __init__(self, ends: tuple[socket.socket, socket.socket]) -> None:
        self.ends = ends
        self.due: list[NetworkFault | None] = [None, None]
        self.open = 2  # number of open directions

    def cut(self) -> None:
        for end in self.ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


class FaultyNetwork:
    """A proxy for connections; `inject` injects a fault into one of them.

    Attributes:
        done: number of injected faults of each kind.
    """

    def __init__(
        self,
        seed: int,
        latency_s: float = 0.0,  # latency of all bytes
    ) -> None:
        self.done: Counter[NetworkFault] = Counter()
        self._random, self._latency_s = random.Random(seed), latency_s
        self._listeners: list[socket.socket] = []
        self._connections: list[_Connection] = []
        self._lock = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._is_closed = False

    def route(self, place: Place) -> Place:
        """Return the address of a new listener that forwards connections to the address `place`."""
        listener = socket.create_server((LOCAL, 0))
        self._listeners.append(listener)
        self._start(partial(self._accept, listener, place))
        found: Place = listener.getsockname()
        return found

    def inject(self, kind: NetworkFault) -> None:
        """Inject a fault into a random connection."""
        with self._lock:
            if not self._connections:
                return
            connection = self._random.choice(self._connections)
            self.done[kind] += 1
        if kind is NetworkFault.CUT:
            connection.cut()
        else:
            connection.due[self._random.randrange(2)] = kind

    def close(self) -> None:
        """End all connections."""
        self._is_closed = True
        for listener in self._listeners:
            with suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)
            listener.close()
        with self._lock:
            for connection in self._connections:
                connection.cut()
        for thread in self._threads:
            thread.join(END_S)

    def _start(self, run: Callable[[], None]) -> None:
        self._threads.append(threading.Thread(target=run, daemon=True))
        self._threads[-1].start()

    def _accept(self, listener: socket.socket, place: Place) -> None:
        with suppress(OSError):
            while not self._is_closed:
                caller, _ = listener.accept()
                try:
                    called = socket.create_connection(place)
                except OSError:
                    caller.close()
                    continue
                for end in (caller, called):
                    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                connection = _Connection((caller, called))
                with self._lock:
                    self._connections.append(connection)
                for direction in (0, 1):
                    self._start(partial(self._carry, connection, direction))

    def _late(self, source: socket.socket) -> Iterator[bytes]:
        """Yield the received pieces, each delayed by the latency."""
        due: deque[tuple[float, bytes]] = deque()
        while True:
            wait_s = max(due[0][0] - time.perf_counter(), 0.0) if due else None
            if not due or select.select([source], [], [], wait_s)[0]:
                if not (data := source.recv(CHUNK)):
                    break
                due.append((time.perf_counter() + self._latency_s, data))
            while due and due[0][0] <= time.perf_counter():
                yield due.popleft()[1]
        for due_s, data in due:
            time.sleep(max(due_s - time.perf_counter(), 0.0))
            yield data

    def _carry(self, connection: _Connection, direction: int) -> None:
        """Forward the bytes of one direction until one end closes."""
        source, target = connection.ends[direction], connection.ends[1 - direction]
        is_mute = False
        with suppress(OSError):
            for data in self._late(source):
                fault, connection.due[direction] = connection.due[direction], None
                if fault is NetworkFault.DELAY:
                    time.sleep(self._random.uniform(0.001, LONGEST_DELAY_S))
                elif fault is NetworkFault.DAMAGE:
                    changed = bytearray(data)
                    changed[self._random.randrange(len(data))] ^= 1 << self._random.randrange(8)
                    data = bytes(changed)
                elif fault is NetworkFault.SILENCE:
                    is_mute = True
                if not is_mute:
                    target.sendall(data)
        connection.cut()
        with self._lock:
            connection.open -= 1
            if connection.open:
                return
            self._connections.remove(connection)
        for end in connection.ends:
            end.close()
